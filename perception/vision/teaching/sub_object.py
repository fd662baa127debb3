"""The outline at a click: the circle, the rectangle or the connected group of edges that a person would point at."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Array
from hal.errors import NotFound
from perception.vision.finding.blind import CIRCLE_RADII_M
from perception.vision.finding.blind import SIDES_M as FOUND_SIDES_M
from perception.vision.finding.circles import find_circles
from perception.vision.finding.components import components
from perception.vision.finding.features import PLATE_PX_PER_M, Ground
from perception.vision.finding.shapes import direction_maps, find_rectangles

# Those of the blind search, and larger ones, because a person may point at anything.
RADII_M = (CIRCLE_RADII_M, (0.036, 0.075))
SIDES_M = (FOUND_SIDES_M, (0.06, 0.16))
LEAST_GROUP_M = 0.008
NEAR_M = 0.006  # largest distance of a click in the middle of an outline from its middle
SURE_COVERAGE = 0.6  # of an outline of which most is visible; weaker ones are used if there is none
LEAST_OVERLAP = 0.4  # of an outline's box with the clicked box; with less the person meant something else
LEAST_EDGES = 12  # strong edge pixels inside a clicked box; the bare plate has none, the smallest lamp has forty
ARC = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SubObject:
    """An outline on the rectified plate.

    Attributes:
        shape: `circle`, `rectangle`, `group` (edges that belong together) or `clicks` (nothing better was found).
        polygon_px: (N, 2) closed outline (u, v) on the rectified plate.
        coverage: share of the outline on which there is an edge; 0 for groups and clicks.
    """

    shape: str
    polygon_px: Array
    coverage: float

    @property
    def middle_px(self) -> Array:
        """Middle (2,) of the outline's bounding box."""
        return np.asarray((self.polygon_px.min(axis=0) + self.polygon_px.max(axis=0)) / 2)

    @property
    def size_px(self) -> Array:
        """Width and height (2,) of that box."""
        return np.asarray(np.ptp(self.polygon_px, axis=0))


def sub_objects(ground: Ground) -> list[SubObject]:
    """Return all closed outlines on the plate that may be those of objects."""
    s, edges = PLATE_PX_PER_M, ground.edges
    found = []
    for low, high in RADII_M:
        for c in find_circles(edges, least_px=low * s, most_px=high * s):
            ring = np.column_stack([c.u + c.radius * np.sin(ARC), c.v - c.radius * np.cos(ARC)])
            found.append(SubObject(shape="circle", polygon_px=ring, coverage=c.coverage))
    maps = direction_maps(edges)
    for low, high in SIDES_M:
        for r in find_rectangles(maps, least_px=low * s, most_px=high * s):
            corners = _box(r.u - r.width / 2, r.v - r.height / 2, r.u + r.width / 2, r.v + r.height / 2)
            found.append(SubObject(shape="rectangle", polygon_px=corners, coverage=r.coverage))
    joined = cv2.morphologyEx(edges.thin.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    for x, y, width, height in components(np.asarray(joined, np.uint8), diagonal=True)[:, :4]:
        if LEAST_GROUP_M * s <= max(width, height) < SIDES_M[-1][1] * s:
            corners = _box(float(x), float(y), float(x + width - 1), float(y + height - 1))
            found.append(SubObject(shape="group", polygon_px=corners, coverage=0.0))
    return found


def outline_at(ground: Ground, clicks_px: Array) -> SubObject:
    """Return the outline that the clicks point at.

    Args:
        clicks_px: (1..3, 2) on the rectified plate: the middle; two opposite corners; both.

    Raises:
        NotFound: there is only bare plate.
    """
    found = sub_objects(ground)
    chosen = _about(found, clicks_px[0]) if len(clicks_px) == 1 else _in_box(found, clicks_px[:2])
    if chosen is None and len(clicks_px) > 1 and _has_edges(ground, clicks_px[:2]):
        (u0, v0), (u1, v1) = clicks_px[:2].min(axis=0), clicks_px[:2].max(axis=0)
        chosen = SubObject(shape="clicks", polygon_px=_box(u0, v0, u1, v1), coverage=0.0)
    if chosen is None:
        raise NotFound(
            "no object has its outline where you clicked: nothing but plate, or too faint",
            hint="click in the middle of one, or on two opposite corners; come closer or use more light if it is faint",
        )
    return chosen


def _about(found: list[SubObject], click: Array) -> SubObject | None:
    """Return the largest well visible outline whose middle is clicked, else the smallest one around the click."""
    near = [o for o in found if np.linalg.norm(o.middle_px - click) < NEAR_M * PLATE_PX_PER_M]
    for least in (SURE_COVERAGE, 0.01, 0.0):
        fitting = [o for o in near if o.coverage >= least]
        if fitting:
            return max(fitting, key=lambda o: float(np.prod(o.size_px)))
    around = [o for o in found if _holds(o, click)]
    return min(around, key=lambda o: float(np.prod(o.size_px)), default=None)


def _in_box(found: list[SubObject], corners: Array) -> SubObject | None:
    """Return the outline whose box is most similar to the clicked one.

    Circles and rectangles are preferred to groups.
    """
    low, high = corners.min(axis=0), corners.max(axis=0)

    def likeness(o: SubObject) -> float:
        a, b = o.polygon_px.min(axis=0), o.polygon_px.max(axis=0)
        common = float(np.prod(np.maximum(np.minimum(high, b) - np.maximum(low, a), 0.0)))
        overlap = common / (float(np.prod(high - low)) + float(np.prod(b - a)) - common + 1e-9)
        return overlap - (0.1 if o.shape == "group" else 0.0)

    best = max(found, key=likeness, default=None)
    return best if best is not None and likeness(best) >= LEAST_OVERLAP else None


def _holds(outline: SubObject, point: Array) -> bool:
    """Return whether an outline contains a point."""
    return cv2.pointPolygonTest(outline.polygon_px.astype(np.float32), (float(point[0]), float(point[1])), False) >= 0


def _has_edges(ground: Ground, corners: Array) -> bool:
    """Return whether there are enough edges in the box between two corners."""
    (u0, v0), (u1, v1) = (np.rint(c).astype(int) for c in (corners.min(axis=0), corners.max(axis=0)))
    return int(ground.edges.thin[max(v0, 0) : v1 + 1, max(u0, 0) : u1 + 1].sum()) >= LEAST_EDGES


def _box(u0: float, v0: float, u1: float, v1: float) -> Array:
    """Return the corners (4, 2) of a box."""
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], float)
