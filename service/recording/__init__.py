"""Recordings of a cell in MCAP: what its devices were asked and answered, and the same again without the devices."""
