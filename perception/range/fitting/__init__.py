"""Surfaces fitted to depths along rays: one surface at a time, compiled."""
