"""Drivers on bad and good wires, measured: `python -m benchmarks.drivers`; one module a subject."""
