"""Find the plate in an image, the outlines on it, and the kinds of object that they resemble."""
