"""Commissioning of a machine and of single devices: checks, conformance tests, reading, recording, new drivers."""
