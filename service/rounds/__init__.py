"""Rounds: missions that the service runs by itself, at the times of a cron expression."""
