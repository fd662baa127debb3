"""Fits of single primitives to depths measured along rays (compiled)."""
