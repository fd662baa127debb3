"""Pixels and ranges to facts: vision, range images, calibration."""
