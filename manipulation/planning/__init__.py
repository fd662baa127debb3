"""Where the arm may go: shapes and gaps, collision-free transfers, straight and curved paths, and their timing."""
