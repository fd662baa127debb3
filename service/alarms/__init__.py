"""Alarms by ISA-18.2: conditions of readings, the life cycle of each alarm, and the desk that keeps them."""
