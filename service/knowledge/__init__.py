"""What a cell remembers: stored images, calibrations, and the kinds and panels that users taught."""
