"""Certificates of readings: what judged cases say about how many sure readings are wrong, and where that holds."""
