"""A taught panel laid onto the image: the edges that its file promises, looked for along their normals."""
