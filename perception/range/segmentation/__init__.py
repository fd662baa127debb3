"""From a grid of blocks to the regions of surfaces: planes first, then models compete, then borders and pieces."""
