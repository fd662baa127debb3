"""Simulated cell: a PyBullet world in a process of its own, and the HAL devices that use it."""
