"""The stored data of a cell: images, calibrations, and the kinds and panels that users taught."""
