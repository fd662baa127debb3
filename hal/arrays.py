"""The array types that everyone speaks, by what they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers: coordinates, matrices, covariances, depths. Shape and unit stand in the docstring of whoever gives it."""

Image = NDArray[np.uint8]
"""Pixels: (H, W) gray or (H, W, 3) RGB."""

Labels = NDArray[np.int32]
"""One label a pixel, (H, W); 0 belongs to nothing."""

Mask = NDArray[np.bool_]
"""One truth value an element."""

Indices = NDArray[np.int64]
"""Whole numbers: positions in another array, counts, kinds."""
