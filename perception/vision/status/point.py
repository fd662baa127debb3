"""The decimal point: what is left at the foot of a gap between digits when the lit segments have been taken away."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.vision.patch import sample_at
from perception.vision.status.comb import AXES, Comb
from perception.vision.status.comb_jit import Float32
from perception.vision.view import Array

RADIUS = 0.075  # of the digit height
LEVEL = 0.45  # of a lit segment: a dot and no dot are equally likely there
LEVEL_SPREAD = 0.07
HIDDEN_ODDS = -0.7  # logarithm, of a point in a gap that is hidden against no point at all


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Number of cells before the decimal point (None without one), and the probability that this is so."""

    place: int | None
    probability: float


def find_point(ink: Float32, seen: Float32, comb: Comb, lit_levels: Array) -> Point:
    """Where the decimal point is.

    A dot template must reach a share of a lit segment's level and stand out from the other gaps. A gap that is hidden says
    nothing.

    Args:
        lit_levels: (cells, 7) levels of the lit segments, 0 for the others.
    """
    drawn, sigma_px = _drawn(ink, comb, lit_levels)
    h = comb.height_px
    dot = _dot(RADIUS * h, sigma_px)
    found = cv2.filter2D(ink - drawn, -1, dot / float((dot * dot).sum()), borderType=cv2.BORDER_REPLICATE)
    gap = (comb.pitch_px - comb.width_px) / comb.width_px
    x, y = (m[None] for m in np.meshgrid(np.linspace(0.25, 0.75, 6), np.linspace(-0.12, 0.06, 7)))
    cell = np.arange(comb.count - 1, dtype=float)[:, None, None]
    if comb.count < 2:
        return Point(place=None, probability=1.0)
    u, v = comb.place(1.0 + gap * x, 1.0 + y, cell)
    lines = (comb.count - 1, -1)
    u, v = u.reshape(lines), np.broadcast_to(v, u.shape).reshape(lines)
    levels = np.asarray(sample_at(found, u, v), float).max(axis=1)
    clear = sample_at(seen, u, v, outside=0.0).mean(axis=1) > 0.6
    amplitude = float(np.percentile(drawn, 99.0))
    levels = levels / np.maximum(_local(lit_levels), 0.2)  # behind glare a dot is dimmer, as its neighbours are
    if not clear.any():
        return Point(place=None, probability=0.5)
    order = np.sort(levels[clear])
    typical = max(float(np.median(order[:-1])), 0.0) if len(order) > 1 else 0.0
    odds = ((levels - typical) / max(amplitude, 1e-6) - LEVEL) / LEVEL_SPREAD
    odds = np.append(np.where(clear, np.clip(odds, -30.0, 30.0), HIDDEN_ODDS), 0.0)  # the last: no point
    share = np.exp(odds - odds.max())
    k = int(share.argmax())
    return Point(place=None if k == len(levels) else k + 1, probability=float(share[k] / share.sum()))


def _local(lit_levels: Array) -> Array:
    """(cells - 1,) lit level beside every gap over the display's."""
    lit = lit_levels > 0
    cells = np.where(lit.any(axis=1), (lit_levels * lit).sum(axis=1) / np.maximum(lit.sum(axis=1), 1), np.nan)
    typical = float(np.nanmedian(cells)) if np.isfinite(cells).any() else 1.0
    cells = np.where(np.isfinite(cells), cells / max(typical, 1e-6), 1.0)
    return np.asarray(np.minimum(0.5 * (cells[:-1] + cells[1:]), 1.0))


def _dot(radius_px: float, sigma_px: float) -> Float32:
    """A blurred disc of unit height before the blur."""
    half = int(np.ceil(radius_px + 2.5 * sigma_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    disc = np.clip(radius_px + 0.5 - np.hypot(x, y), 0.0, 1.0).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(disc, (0, 0), max(sigma_px, 0.3), borderType=cv2.BORDER_CONSTANT), np.float32)


def _drawn(ink: Float32, comb: Comb, levels: Array) -> tuple[Float32, float]:
    """The lit segments as drawn strokes with the width and blur that leave the least, and that blur in px."""
    h = comb.height_px
    tried = []
    for stroke in (0.09, 0.13):
        canvas = _strokes(ink.shape, comb, levels, max(1, round(stroke * h)))
        for sigma in (0.02 * h, 0.05 * h, 0.09 * h):
            shape = np.asarray(cv2.GaussianBlur(canvas, (0, 0), max(sigma, 0.3)), np.float32)
            fit = shape * (_dot_product(shape, ink) / max(_dot_product(shape, shape), 1e-6))
            tried.append((cv2.norm(ink, fit, cv2.NORM_L2SQR), fit, sigma))
    _, fit, sigma = min(tried, key=lambda t: t[0])
    return np.asarray(fit, np.float32), float(sigma)


def _dot_product(a: Float32, b: Float32) -> float:
    """Sum of products of two pictures."""
    return float(np.dot(a.ravel(), b.ravel()))


def _strokes(shape: tuple[int, ...], comb: Comb, levels: Array, thickness_px: int) -> Float32:
    canvas = np.zeros(shape, np.float32)
    for k, j in zip(*np.nonzero(levels > 0), strict=True):
        start, end = AXES[j]
        ends = start + np.array([[0.12], [0.88]]) * (end - start)
        u, v = comb.place(ends[:, 0], ends[:, 1], np.array(float(k)))
        (u0, u1), (v0, v1) = np.round(u * 16).astype(int), np.round(v * 16).astype(int)
        cv2.line(canvas, (int(u0), int(v0)), (int(u1), int(v1)), float(levels[k, j]), thickness_px, cv2.LINE_AA, 4)
    return canvas
