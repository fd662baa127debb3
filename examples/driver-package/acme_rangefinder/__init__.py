"""Rangefinder for panelwright."""
