"""The compiler settings of the four-light pose, and the one small product that all its loops share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile to machine code, cached beside the source; division by zero gives inf as in numpy."""
    return cast("Callable[..., Any]", numba.njit(cache=True, error_model="numpy")(function))


@jit
def product3(A, B):  # type: ignore[no-untyped-def]
    """3x3 product without the call into BLAS, which costs more than the product."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C
