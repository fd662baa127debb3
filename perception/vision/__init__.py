"""Pixels to facts: lights, pose, segmentation, features, matching and reading."""
