"""Residuals of quadratics in small windows of a range image: what no smooth surface explains there."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hal.arrays import Array


def quadratics(side: int) -> Array:
    """Return the orthonormal polynomials (6, side^2) up to degree 2 on a square window, those of low degree first."""
    t = np.arange(side) - (side - 1) / 2
    v, u = np.meshgrid(t, t, indexing="ij")
    columns = [np.ones_like(u), u, v, u * u, u * v, v * v]
    q, _ = np.linalg.qr(np.stack([c.ravel() for c in columns], axis=1))
    return np.ascontiguousarray(q.T)


def window_rms(
    g: Array, basis: Array, first: int, *, spacing_px: int, stride_px: int, perspective: bool
) -> tuple[Array, Array, Array]:
    """Return depth and residuals of each window without missing samples, three arrays (N,) in metres.

    These are the depth at the middle of the window, the rms residual after a fit of the first `first` polynomials of
    `basis` (see `quadratics`), and the rms residual after a fit of all of them.

    Args:
        g: (H, W) 1 / depth (`perspective`) or depth; not smaller than a window.
        spacing_px: distance of neighbouring samples of a window.
        stride_px: distance of neighbouring windows.
    """
    samples = basis.shape[1]
    side = round(samples**0.5)
    extent = (side - 1) * spacing_px + 1
    windows = sliding_window_view(g, (extent, extent))[::stride_px, ::stride_px, ::spacing_px, ::spacing_px]
    values = windows.reshape(-1, samples)
    middle = values[:, samples // 2]
    off = values - middle[:, None]
    total, explained = np.einsum("ij,ij->i", off, off), (off @ basis.T) ** 2
    known = np.isfinite(total)
    z = 1.0 / middle[known] if perspective else middle[known]
    scale = (z * z if perspective else 1.0) / side  # dz = z^2 dw
    some, left = total - explained[:, :first] @ np.ones(first), total - explained @ np.ones(len(basis))
    return z, np.sqrt(np.maximum(some[known], 0.0)) * scale, np.sqrt(np.maximum(left[known], 0.0)) * scale
