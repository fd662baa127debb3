"""The array types that all packages share, named by their content."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers: coordinates, matrices, covariances, depths. Shape and unit are given in the docstring of the function."""

Image = NDArray[np.uint8]
"""Pixels: (H, W) gray or (H, W, 3) RGB."""

Labels = NDArray[np.int32]
"""One label per pixel, (H, W); 0 means no label."""

Mask = NDArray[np.bool_]
"""One Boolean value per element."""

Indices = NDArray[np.int64]
"""Integers: indices into another array, counts, kinds."""
