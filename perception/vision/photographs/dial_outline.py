"""Search for the outline of a dial that fills the picture: its middle and radius; and its fit, also to an ellipse."""

from __future__ import annotations

import cv2
import numpy as np

from hal.arrays import Array, Image
from perception.vision.bilinear import polar_values
from perception.vision.finding.circles import find_circles
from perception.vision.finding.shapes import find_edges

SIDE_PX = 220
LEAST_SIDE_PX = 90  # smaller pictures are enlarged to this
UNSEEN_RIM = 0.48  # of the picture's side: the radius if no outline is found
# Least coverage of an outline, relative to the best one; the arc of a scale covers only three quarters of a turn.
WHOLE = 0.9
TURNS = np.linspace(0, 2 * np.pi, 120, endpoint=False)
NORMALS = np.column_stack([np.sin(TURNS), -np.cos(TURNS)])
REACHES = (0.12, 0.07, 0.04, 0.04)  # of the radius, on either side of the current outline
LEAST_REACH_PX = 1.0
LEAST_SLOPE = 0.3  # relative to the median along the outline


def dial_circle(gray: Image, scale: float) -> tuple[float, float, float]:
    """Return middle and radius of the face's round outline near the picture's middle, both multiplied by `scale`.

    Of the two outlines of a bezel the inner one is that of the face; the outer one is displaced, because it stands out
    of the plate. If there is no outline, the result is the inscribed circle of the picture. A small picture is searched
    at about its own size, because enlarged edges would be too faint.
    """
    own = np.clip(max(gray.shape), LEAST_SIDE_PX, SIDE_PX) / max(gray.shape)
    interpolation = cv2.INTER_AREA if own < 1 else cv2.INTER_CUBIC
    picture = np.asarray(cv2.resize(gray, None, fx=own, fy=own, interpolation=interpolation), np.uint8)
    height, width = picture.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    most = 0.52 * max(width, height)
    circles = [
        c
        for c in find_circles(find_edges(picture, sigma_px=1.5), least_px=0.55 * most, most_px=most)
        if np.hypot(c.u - middle[0], c.v - middle[1]) < 0.12 * most
    ]
    ratio = scale / own
    if not circles:
        return float(middle[0]) * ratio, float(middle[1]) * ratio, UNSEEN_RIM * min(width, height) * ratio
    whole = WHOLE * max(c.coverage for c in circles)
    best = min((c for c in circles if c.coverage >= whole), key=lambda c: c.radius)
    fitted, rim = settled(picture, np.array([best.u, best.v]), best.radius * np.eye(2), is_round=True)
    return float(fitted[0]) * ratio, float(fitted[1]) * ratio, float(rim[0, 0]) * ratio


def settled(picture: Image, middle: Array, rim: Array, *, is_round: bool) -> tuple[Array, Array]:
    """Return middle and rim of an outline fitted to the steepest change across it, of the sign that prevails along it.

    This is needed because votes may place an outline anywhere on a wide edge.

    Args:
        picture: (H, W) uint8.
        middle: (2,) px.
        rim: (2, 2) px: a point of the unit circle times it is a point of the outline, seen from its middle.
        is_round: whether only middle and size are fitted; the shape of the ellipse is, too, if not.
    """
    smooth: Image = np.ascontiguousarray(cv2.GaussianBlur(picture, (0, 0), 1.0), np.uint8)
    x, y = NORMALS.T
    J = np.column_stack([x, y, np.ones(len(TURNS)), x * x - y * y, 2 * x * y])[:, : 3 if is_round else 5]
    for reach in REACHES:
        size = float(np.sqrt(abs(np.linalg.det(rim))))
        if reach * size < LEAST_REACH_PX:
            break
        radii = np.arange(1 - reach, 1 + reach, 0.5 / size)
        slope = np.diff(
            polar_values(smooth, (float(middle[0]), float(middle[1])), radii, np.ascontiguousarray(rim @ NORMALS.T)),
            axis=0,
        )
        slope *= np.sign((slope * np.abs(slope)).sum())
        off = radii[slope.argmax(axis=0)] + 0.25 / size - 1.0
        steep = slope.max(axis=0)
        found = steep > LEAST_SLOPE * np.median(steep)
        if not found.any():
            break
        solution = np.zeros(J.shape[1])
        solution[2] = np.median(off[found])
        for _ in range(8):
            residual = off - J @ solution
            spread = max(0.5 / size, 1.4826 * float(np.median(np.abs(residual[found]))))
            weight = found / (1 + (residual / spread) ** 2) ** 2
            solution = np.linalg.solve(J.T @ (weight[:, None] * J) + 1e-6 * np.eye(J.shape[1]), J.T @ (weight * off))
        growth = (1 + solution[2]) * np.eye(2)
        if not is_round:
            growth += np.array([[solution[3], solution[4]], [solution[4], -solution[3]]])
        middle, rim = middle + rim @ solution[:2], rim @ growth
    return middle, rim
