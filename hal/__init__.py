"""The hardware abstraction layer: devices, values with units, frames, time, errors, cell and panel files."""
