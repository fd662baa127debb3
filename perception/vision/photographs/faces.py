"""Search for the round faces of instruments anywhere in a picture, also seen aslant, and their view from straight ahead.

A circle that is seen aslant is an ellipse. The picture is stretched in several directions, so that in one of the stretched
pictures the ellipse is nearly a circle, which `find_circles` finds; the ellipse is then fitted in the picture itself.

Perspective moves the middle of a circle beside that of its ellipse. The pivot's round cap shows where it is. The projective
map that keeps the unit circle and brings that point to the middle is a translation in Klein's model of the hyperbolic plane.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from perception.vision.finding.circles import ALIGNED, NORMALS, find_circles
from perception.vision.finding.shapes import Edges, find_edges
from perception.vision.image import as_gray
from perception.vision.photographs.dial_outline import settled

# Larger pictures are reduced to the first of these; larger faces are searched in a picture that is reduced further, because
# what the stretching leaves of an ellipse grows with it. Each with the least and the most radius, as shares of the side.
LEVELS = ((480, 0.045, 0.13), (200, 0.12, 0.5))
SEARCH_PX, LEAST_RADIUS, MOST_RADIUS = LEVELS[0][0], LEVELS[0][1], LEVELS[-1][2]
SIGMA_PX = 1.5
# Ratios of an ellipse's axes and number of directions in which the picture is stretched by them: up to 50 degrees.
ASLANT = ((0.9, 4), (0.8, 6), (0.7, 8), (0.62, 8))
FLATTEST = 0.55  # least ratio of the axes
CIRCLES_TRIED = 12  # in each stretched picture
LEAST_COVERAGE, CLEAR_COVERAGE = 0.5, 0.9
BESIDE = (-1.5, -0.75, 0.0, 0.75, 1.5)  # px across the outline in which its edge may be
SAME_MIDDLE = 0.25  # of the larger face's size: faces with middles as near are rims and rings of one instrument
WHOLE = 0.85  # least coverage of a face, relative to the best one of its instrument
MARGIN = 1.12  # radius of the view of a face over the face's
MOST_VIEW_PX = 900
MOST_GROUPS, MOST_FACES = 20, 6
CAP_PX = 150.0  # radius of the view in which the pivot's cap is searched
CAP_RADII, CAP_WITHIN = (0.045, 0.2), 0.22  # shares of the face's radius: of the cap, and its distance from the middle
CAP_SIGMA_PX = 1.2
LEAST_CAP = 0.75  # of the cap's outline that has an edge
NEAREST = 0.7  # least focal length over the picture's longer side, which limits what perspective can do
STEEP = 0.78  # ratio of the axes: of drawn gauges that were surely read at more than 40 degrees one of six was wrong
USUAL_FOCAL = 1.0  # focal length over the picture's longer side
OFF_CAP = 0.04  # of the radius, by which the middle may be elsewhere for other reasons


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Face:
    """A round face in a picture.

    Attributes:
        middle: (2,) px.
        rim: (2, 2) px, symmetric: a point of the unit circle times it is a point of the outline, seen from the middle.
        coverage: share of the outline that has an edge.
        pivot: where the middle of the circle is seen, on the unit disc whose rim is the outline.
        has_cap: whether a cap about the pivot shows that.
    """

    middle: Array
    rim: Array
    coverage: float
    pivot: tuple[float, float] = (0.0, 0.0)
    has_cap: bool = False

    @property
    def is_clear(self) -> bool:
        """Whether it is surely round, or has a pivot, rather than by chance."""
        return self.has_cap or self.coverage >= CLEAR_COVERAGE

    @property
    def is_steep(self) -> bool:
        """Whether it is seen so much aslant that a pivot a little beside its place shows in the reading."""
        minor, major = np.linalg.eigvalsh(self.rim)
        return bool(minor < STEEP * major)

    @property
    def size_px(self) -> float:
        """Mean radius."""
        return float(np.sqrt(np.linalg.det(self.rim)))

    def otherwise(self, side_px: int) -> Iterator[Face]:
        """Yield it with other places of its pivot: in the middle, and where a usual camera shows it at this tilt.

        The outline does not tell which end of the short axis is nearer to the camera. `side_px`: longer side of the picture.
        """
        (minor, major), axes = np.linalg.eigh(self.rim)
        off = np.sqrt(max(0.0, 1.0 - (minor / major) ** 2)) * major / (USUAL_FOCAL * side_px)
        for share in (0.0, 1.0, -1.0) if self.has_cap else (1.0, -1.0):
            x, y = share * off * axes[:, 0]
            yield replace(self, pivot=(float(x), float(y)), has_cap=False)

    def view(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Array]:
        """Return the face as seen from straight ahead, filling the picture, and `image_from_view` (3, 3) for pixels."""
        half = round(min(MARGIN * float(np.linalg.norm(self.rim, 2)), 0.5 * MOST_VIEW_PX))
        circle_from_view = np.array([[MARGIN / half, 0.0, -MARGIN], [0.0, MARGIN / half, -MARGIN], [0.0, 0.0, 1.0]])
        image_from_circle = np.vstack([np.column_stack([self.rim, self.middle]), [0.0, 0.0, 1.0]])
        reduced, smooth = float(np.linalg.norm(self.rim, 2)) * MARGIN / half, image
        if reduced > 1.4:
            smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.4 * reduced), np.uint8)
        image_from_view = image_from_circle @ moving_to_middle(self.pivot) @ circle_from_view
        seen = cv2.warpPerspective(
            smooth, image_from_view, (2 * half + 1, 2 * half + 1), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return np.asarray(seen, np.uint8), image_from_view


def moving_to_middle(point: tuple[float, float]) -> Array:
    """Return the projective map (3, 3) that keeps the unit circle and moves its middle to a point in it."""
    away = float(np.hypot(*point))
    if away == 0.0:
        return np.eye(3)
    c, s = point[0] / away, point[1] / away
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    along = np.array([[1.0, 0.0, away], [0.0, np.sqrt(1.0 - away * away), 0.0], [away, 0.0, 1.0]])
    return np.asarray(turn @ along @ turn.T)


def find_faces(image: NDArray[np.uint8]) -> list[Face]:
    """Return the round faces in a picture, those with a cap first, one for each instrument, at most MOST_FACES.

    Args:
        image: (H, W) gray or (H, W, 3) RGB uint8.
    """
    gray = as_gray(image)
    scale = min(1.0, SEARCH_PX / max(gray.shape))
    small = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    edges = find_edges(small, sigma_px=SIGMA_PX)
    found = [
        Face(middle=(middle + 0.5) / scale - 0.5, rim=rim / scale, coverage=coverage)
        for middle, rim in _ellipses(small)
        if (coverage := _coverage(edges, middle, rim)) >= LEAST_COVERAGE
    ]
    return _of_each_instrument(gray, found)


def _with_cap(gray: Image, face: Face) -> Face:
    """Return a face with the place of its pivot, if a cap shows it where perspective can move it."""
    view, _ = face.view(gray)
    scale = min(1.0, CAP_PX * MARGIN / (0.5 * len(view)))
    small = np.asarray(cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    radius, middle = 0.5 * (len(small) - 1) / MARGIN, (len(small) - 1) // 2
    reach = round((CAP_WITHIN + CAP_RADII[1]) * radius)
    part = np.ascontiguousarray(small[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1])
    least_px, most_px = (share * radius for share in CAP_RADII)
    caps = [
        (cap.coverage * cap.radius, ((cap.u - reach) / radius, (cap.v - reach) / radius))
        for cap in find_circles(find_edges(part, sigma_px=CAP_SIGMA_PX), least_px=least_px, most_px=most_px)
        if cap.coverage >= LEAST_CAP
    ]
    caps = [cap for cap in caps if _is_perspective(face, cap[1], max(gray.shape))]
    return replace(face, pivot=max(caps)[1], has_cap=True) if caps else face


def _is_perspective(face: Face, pivot: tuple[float, float], side_px: int) -> bool:
    """Return whether a tilt can move the middle of a face there: along the short axis, by sin(tilt) radius / distance."""
    (minor, major), axes = np.linalg.eigh(face.rim)
    along, across = np.abs(axes.T @ pivot)
    most = np.sqrt(max(0.0, 1.0 - (minor / major) ** 2)) * major / (NEAREST * side_px)
    return bool(along < min(CAP_WITHIN, most + OFF_CAP) and across < OFF_CAP)


def _ellipses(small: Image) -> Iterator[tuple[Array, Array]]:
    """Yield middle and symmetric rim of the ellipses that look round in one of the stretched pictures."""
    side = max(small.shape)
    for guess in _guesses(small):
        middle, rim = settled(small, *guess, is_round=False)
        # The same outline without a rotation: the square root of a symmetric matrix.
        values, axes = np.linalg.eigh(rim @ rim.T)
        minor, major = np.sqrt(values)
        if minor >= max(FLATTEST * major, 0.8 * FLATTEST * LEAST_RADIUS * side) and major <= 1.2 * MOST_RADIUS * side:
            yield middle, axes @ np.diag(np.sqrt(values)) @ axes.T


def _guesses(small: Image) -> Iterator[tuple[Array, Array]]:
    """Yield middle and rim of the circles in stretched and reduced pictures, in the coordinates of the given one."""
    for side, least, most in LEVELS:
        scale = min(1.0, side / max(small.shape))
        least_px, most_px = (share * scale * max(small.shape) for share in (least, most))
        for direction in _stretches():
            stretch = scale * direction
            corners = stretch @ (np.array([[0, 1, 0, 1], [0, 0, 1, 1]]) * np.array(small.shape[::-1])[:, None])
            low = corners.min(axis=1)
            width, height = np.ceil(np.ptp(corners, axis=1)).astype(int).tolist()
            move = np.column_stack([stretch, -low])
            smooth = cv2.GaussianBlur(small, (0, 0), 0.4 / scale) if scale < 0.7 else small
            stretched = np.asarray(
                cv2.warpAffine(smooth, move, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8
            )
            circles = find_circles(find_edges(stretched, sigma_px=SIGMA_PX), least_px=least_px, most_px=most_px)
            back = np.linalg.inv(stretch)
            for circle in circles[:CIRCLES_TRIED]:
                yield back @ (np.array([circle.u, circle.v]) + low), circle.radius * back


def _stretches() -> Iterator[Array]:
    """Yield symmetric matrices (2, 2) that lengthen one direction of a picture, and that which changes nothing."""
    yield np.eye(2)
    for ratio, directions in ASLANT:
        for k in range(directions):
            along = np.array([np.cos(np.pi * k / directions), np.sin(np.pi * k / directions)])
            yield np.eye(2) + (1.0 / ratio - 1.0) * np.outer(along, along)


def _coverage(edges: Edges, middle: Array, rim: Array) -> float:
    """Return the share of an outline near which there is an edge along its normal."""
    points = rim @ NORMALS.T
    across = np.linalg.inv(rim) @ NORMALS.T  # the normals of an ellipse with a symmetric rim
    across /= np.linalg.norm(across, axis=0)
    hit = np.zeros(len(NORMALS), bool)
    height, width = edges.strong.shape
    for beside in BESIDE:
        u, v = np.rint(middle[:, None] + points + beside * across).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
        along = np.abs(edges.along_x[v, u] * across[0] + edges.along_y[v, u] * across[1])
        hit |= inside & edges.strong[v, u] & (along > ALIGNED * edges.strength[v, u])
    return float(hit.mean())


def _of_each_instrument(gray: Image, found: list[Face]) -> list[Face]:
    """Return of each group of concentric outlines the largest of the complete ones; those with a cap come first.

    The face of an instrument has a rim around it, and rings on it.
    """
    kept: list[Face] = []
    left = sorted(found, key=lambda face: -face.coverage)
    while left and len(kept) < MOST_GROUPS:
        best = left[0]
        group = [face for face in left if _is_about(face, best)]
        whole = [_with_cap(gray, one) for one in group if one.coverage >= WHOLE * best.coverage]
        kept.append(max(whole, key=lambda one: (one.has_cap, one.size_px)))
        left = [face for face in left if not _is_about(face, kept[-1]) and not _is_about(face, best)]
    return sorted(kept, key=lambda face: (not face.has_cap, -face.coverage))[:MOST_FACES]


def _is_about(one: Face, other: Face) -> bool:
    """Return whether two outlines have nearly the same middle."""
    apart = float(np.hypot(*(one.middle - other.middle)))
    return apart < SAME_MIDDLE * max(one.size_px, other.size_px)
