"""Residuals of quadratics in small windows of a range image: what no smooth surface explains there."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled


def quadratics(side: int) -> Array:
    """Return the orthonormal polynomials (6, side^2) up to degree 2 on a square window, those of low degree first."""
    t = np.arange(side) - (side - 1) / 2
    v, u = np.meshgrid(t, t, indexing="ij")
    columns = [np.ones_like(u), u, v, u * u, u * v, v * v]
    q, _ = np.linalg.qr(np.stack([c.ravel() for c in columns], axis=1))
    return np.ascontiguousarray(q.T)


@compiled
def window_rms(
    g: Array, basis: Array, first: int, spacing: int, stride: int, perspective: bool,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return depth and residuals of each window without missing samples, three arrays (N,) in metres.

    These are the depth at the middle of the window, the rms residual after a fit of the first `first` polynomials of
    `basis` (see `quadratics`), and the rms residual after a fit of all of them.

    Args:
        g: (H, W) 1 / depth (`perspective`) or depth.
        spacing: distance of neighbouring samples of a window in pixels.
        stride: distance of neighbouring windows in pixels.
    """
    H, W = g.shape
    side = int(np.sqrt(basis.shape[1]) + 0.5)
    extent = (side - 1) * spacing + 1
    count = ((H - extent) // stride + 1) * ((W - extent) // stride + 1)
    z_out, first_out, rms_out = np.empty(count), np.empty(count), np.empty(count)
    across = max((W - extent) // stride + 1, 0)
    values, total, dot = np.empty((side * side, across)), np.empty(across), np.empty(across)
    some = np.empty(across)
    n = 0
    for top in range(0, H - extent + 1, stride):
        middle = g[top + extent // 2, extent // 2 :: stride]
        _squares_left(g[top:], middle, basis, first, spacing, stride, values, dot, some, total)
        for c in range(across):
            if not np.isfinite(total[c]):
                continue
            z = 1.0 / middle[c] if perspective else middle[c]
            z_out[n] = z
            flat, rms = np.sqrt(max(some[c], 0.0)) / side, np.sqrt(max(total[c], 0.0)) / side
            first_out[n] = flat * z * z if perspective else flat  # dz = z^2 dw
            rms_out[n] = rms * z * z if perspective else rms
            n += 1
    return z_out[:n], first_out[:n], rms_out[:n]


@compiled
def _squares_left(
    g: Array, middle: Array, basis: Array, first: int, spacing: int, stride: int, values: Array, dot: Array,
    some: Array, total: Array,
) -> None:  # fmt: skip
    """Compute the residual sums of squares of all windows that begin in the first row of `g`.

    Writes those after a fit of the first polynomials into `some`, and after a fit of all into `total`. The windows of a
    row are processed together, so that the loops have no branch.
    """
    side = int(np.sqrt(basis.shape[1]) + 0.5)
    total[:] = 0.0
    for k in range(side * side):
        _load_sample(g[k // side * spacing, k % side * spacing :: stride], middle, values[k], total)
    for m in range(basis.shape[0]):
        dot[:] = 0.0
        for k in range(side * side):
            _add_multiple(basis[m, k], values[k], dot)
        _subtract_square(dot, total)
        if m == first - 1:
            for c in range(total.shape[0]):
                some[c] = total[c]


@compiled
def _load_sample(samples: Array, middle: Array, values: Array, total: Array) -> None:
    """Write one sample of each window, relative to its middle, into `values`, and add its square to `total`."""
    for c in range(values.shape[0]):
        value = samples[c] - middle[c]
        values[c] = value
        total[c] += value * value


@compiled
def _add_multiple(factor: float, values: Array, out: Array) -> None:
    """Add `factor` times `values` to `out`."""
    for c in range(out.shape[0]):
        out[c] += factor * values[c]


@compiled
def _subtract_square(values: Array, out: Array) -> None:
    """Subtract the squares of `values` from `out`."""
    for c in range(out.shape[0]):
        out[c] -= values[c] * values[c]
