"""Tests of the simulated week."""
