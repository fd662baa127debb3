"""Breaks a running service on purpose, and judges by invariants what it does then."""
