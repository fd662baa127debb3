"""Drivers for real devices: one file or folder per device.

`kinds/` holds what devices of one kind share, `transport/` the communication links, and `emulators/` the
emulated device at the other end of each link.
"""
