"""Emulated devices: each speaks a real protocol, takes its values from any HAL device and can inject faults."""
