"""Photographs of devices that no panel file describes: one dial, one display."""
