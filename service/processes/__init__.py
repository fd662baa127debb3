"""The processes of a running cell, `cell` and `stop`: how they are started, watched and connected.

`supervisor` starts, watches and restarts them; `child` is one process that cannot outlive its parent; `latch` is the byte of
shared memory that holds the software stop; `connection` is the service's access to the cell; `device_slots` holds the cell's
devices and replaces them; `motion` connects the devices to the control thread.
"""
