"""Registration of a taught panel to the image: its edges are searched along their normals."""
