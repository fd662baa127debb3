"""The words everyone speaks: devices, values with units, frames, time, errors, cell and panel files."""
