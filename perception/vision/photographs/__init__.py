"""Readers of photographs of single devices (a dial or a display) without a panel file."""
