"""Cables in front of an object: bands that come in over its border on one side and leave on another.

Where a cable crosses a dark window its gray may be the window's, on the plate just outside it is plain; where its gray is
the plate's it is plain in the window. So a closed path around the object and one just inside its border are searched for
places that stand out, and every two of them on one path that match in gray and width are joined by a band, which must have
one gray all along, straight or with one bend.
"""

from __future__ import annotations

from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.patch import Patch, sample_at
from perception.vision.status.cover import OUTSIDE, Crossing, border_crossings, smoothed
from perception.vision.view import Array

SAME_GRAY = 16.0  # levels along a band; real cables shine a little
GROUND_SHARE = 0.5  # of what a band within the window stands out by
ALONG_SHARE = 0.72  # of the band's axis that must have its gray
INSET = 0.09  # of the smaller side, from the border to the path within: clear of a frame, and no digits yet
MOST_WIDTH = 0.5  # of the object's smaller side: wider things are not looked past
BENDS = (0.0, -0.3, 0.3, -0.6, 0.6, -1.0, 1.0, -1.6, 1.6, -2.3, 2.3)  # of the band's width, sideways
INK_EDGE_PX = 4.0
BENT_AT = (0.5, 0.3, 0.7)  # of its length


def hidden_by_bands(
    patch: Patch, *, half_width_m: float, half_height_m: float, dark_ink: bool
) -> NDArray[np.bool_] | None:
    """(H, W) mask of the cables that cross a display in the patch; None when none does.

    Args:
        dark_ink: whether segments are darker than their ground. The blurred edge of a cable that differs from the ground as
            segments do would pass for ink, so it is hidden too; any other edge shows what lies beside it.
    """
    smooth = smoothed(patch)
    inset = INSET * 2 * min(half_width_m, half_height_m)
    paths = [
        border_crossings(
            patch, half_width_m=half_width_m - less, half_height_m=half_height_m - less, is_round=False, beyond=beyond,
            smooth=smooth,
        )
        for less, beyond in ((0.0, OUTSIDE), (inset, 0.0))
    ]  # fmt: skip
    if max(len(ends) for ends in paths) < 2:
        return None
    least_side = 2 * min(half_width_m, half_height_m) * patch.px_per_m
    mask = np.zeros(patch.gray.shape, np.uint8)
    ground = _ground(patch, half_width_m, half_height_m)
    for (a, b), within in (
        (pair, within) for ends, within in zip(paths, (False, True), strict=True) for pair in combinations(ends, 2)
    ):
        # Within the window its ground is what the band must not be taken for.
        tolerance = min(SAME_GRAY, GROUND_SHARE * min(a.by, b.by)) if within else SAME_GRAY
        line = _joined(smooth, a, b, least_side, tolerance)
        if line is not None:
            points, width = line
            width += INK_EDGE_PX if ((a.gray + b.gray) / 2 < ground - SAME_GRAY / 2) == dark_ink else 0.0
            cv2.polylines(mask, [np.round(points * 16).astype(np.int32)], False, 1, max(1, round(width)), cv2.LINE_8, 4)
    return mask > 0 if mask.any() else None


def _ground(patch: Patch, half_width_m: float, half_height_m: float) -> float:
    """Typical gray of the window."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 24) * half_width_m, np.linspace(-0.8, 0.8, 12) * half_height_m)
    return float(np.median(patch.sample(x, y, 0.0)))


def _joined(
    smooth: NDArray[np.uint8], a: Crossing, b: Crossing, least_side_px: float, tolerance: float
) -> tuple[Array, float] | None:
    """(3, 2) axis and width in px of the band between two places on the border; None when there is none."""
    if a.side == b.side or abs(a.gray - b.gray) > 2 * SAME_GRAY or a.is_darker != b.is_darker:
        return None
    along = b.middle_px - a.middle_px
    length = float(np.linalg.norm(along))
    if length < 0.4 * least_side_px:
        return None
    along = along / length
    widths = [end.length_px * abs(float(along[0] * end.tangent[1] - along[1] * end.tangent[0])) for end in (a, b)]
    width = max(widths)
    if min(widths) < 1.0 or width > MOST_WIDTH * least_side_px or width > 2.2 * min(widths):
        return None
    across = np.array([-along[1], along[0]]) * width
    t = np.linspace(0.0, 1.0, max(12, round(length / 1.5)))
    wanted = a.gray + t * (b.gray - a.gray)
    shapes = list(product(BENT_AT, BENDS))
    middles = np.array([a.middle_px + at * (b.middle_px - a.middle_px) + bend * across for at, bend in shapes])
    knots = np.array([at for at, _ in shapes])[:, None]
    first, second = np.minimum(t / knots, 1.0), np.maximum((t - knots) / (1.0 - knots), 0.0)  # along either leg
    axes = (
        a.middle_px
        + first[..., None] * (middles - a.middle_px)[:, None]
        + second[..., None] * (b.middle_px - middles)[:, None]
    )
    sides = np.array([-0.2, 0.0, 0.2])[:, None] * across * (min(widths) / width)
    points = axes[:, None] + sides[:, None]  # (shapes, sides, along, 2)
    flat = points.reshape(len(shapes), -1, 2)
    off = np.abs(sample_at(smooth, flat[..., 0], flat[..., 1]) - np.tile(wanted, len(sides)))
    shares = np.count_nonzero(off < tolerance, axis=1) / off.shape[1]
    k = int(
        (shares + 0.01 * np.array([bend == 0.0 for _, bend in shapes])).argmax()
    )  # straight unless a bend is better
    if shares[k] < ALONG_SHARE:
        return None
    return np.array([a.middle_px, middles[k], b.middle_px]), width
