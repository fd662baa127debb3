"""Real devices: one file a device, `transport/` for the wires, `emulators/` for the far side of each wire."""
