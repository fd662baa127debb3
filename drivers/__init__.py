"""Real devices: one file or folder a device, `kinds/` for what those of a kind share, `transport/` for the wires,
`emulators/` for the far side of each wire.
"""
