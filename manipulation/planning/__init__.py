"""Planning: collision shapes and distances, collision-free transfers, straight and curved paths, and their timing."""
