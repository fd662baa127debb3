"""What stands where in an image: the plate, the outlines on it, and the kinds that they look like."""
