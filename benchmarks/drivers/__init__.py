"""Benchmarks of drivers on faulty and on good links: `python -m benchmarks.drivers`; one module per subject."""
