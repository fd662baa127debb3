"""A joint path with rounded corners, and its derivatives along it.

Before and behind each corner of a polyline the path is straight. Within `reach` of it the direction changes from one
leg's to the other's by a cosine-shaped curvature, so that position, direction, curvature and its change are continuous:
a curvature that begins at once asks for an acceleration that begins at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined

SHORTEST_RAD = 1e-9
SHARE = 0.49  # of a leg may belong to the rounding at each of its ends


@inlined
def corner_shape(s: float, reach: float, out: Array) -> None:
    """Write g, g', g'', g''' (4,) of the smooth ramp at a distance `s` from the corner, |s| <= reach.

    g grows from 0 to `reach`; g'' = (1 + cos(pi s / d)) / 2 d has area 1, so g' grows from 0 to 1.
    """
    d, w = reach, np.pi / reach
    sine, cosine = np.sin(w * s), np.cos(w * s)
    out[0] = 0.5 * (s + d) + (s * s - d * d) / (4.0 * d) - (1.0 + cosine) * d / (2.0 * np.pi * np.pi)
    out[1] = 0.5 + 0.5 * s / d + sine / (2.0 * np.pi)
    out[2] = 0.5 * (1.0 + cosine) / d
    out[3] = -0.5 * w * sine / d


@compiled
def path_at(points: Array, marks: Array, reaches: Array, grid: Array) -> Array:
    """Return the path and its first three derivatives (4, N, n) at distances `grid` (N,).

    Args:
        points: (M, n) corners of the polyline.
        marks: (M,) their distances along it.
        reaches: (M,) half lengths of the roundings; those of the ends are not used.
    """
    m, n = points.shape
    out = np.zeros((4, grid.shape[0], n))
    shape = np.zeros(4)
    for row in range(grid.shape[0]):
        s = grid[row]
        leg = min(max(np.searchsorted(marks, s, side="right") - 1, 0), m - 2)
        at = leg + 1 if s - marks[leg] > marks[leg + 1] - s else leg  # the nearer corner
        offset = s - marks[at]
        if 0 < at < m - 1 and abs(offset) < reaches[at]:
            corner_shape(offset, reaches[at], shape)
            for k in range(n):
                back = (points[at, k] - points[at - 1, k]) / (marks[at] - marks[at - 1])
                ahead = (points[at + 1, k] - points[at, k]) / (marks[at + 1] - marks[at])
                out[0, row, k] = points[at, k] + back * (offset - shape[0]) + ahead * shape[0]
                out[1, row, k] = back + (ahead - back) * shape[1]
                out[2, row, k] = (ahead - back) * shape[2]
                out[3, row, k] = (ahead - back) * shape[3]
        else:
            for k in range(n):
                slope = (points[leg + 1, k] - points[leg, k]) / (marks[leg + 1] - marks[leg])
                out[0, row, k] = points[leg, k] + slope * (s - marks[leg])
                out[1, row, k] = slope
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmoothPath:
    """A polyline (M, n) in joint space, M >= 2, whose inner corners are rounded within `reaches_rad` (M,) of them."""

    points_rad: Array
    marks_rad: Array
    reaches_rad: Array

    @classmethod
    def of(cls, points_rad: Array, reaches_rad: Array | None = None) -> SmoothPath:
        """Make the path; without `reaches_rad` each rounding takes all of the shorter leg that it may have."""
        points = _without_repeats(np.asarray(points_rad, float))
        legs = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), SHORTEST_RAD)
        marks = np.concatenate([[0.0], np.cumsum(legs)])
        most = np.zeros(len(points))
        most[1:-1] = SHARE * np.minimum(legs[:-1], legs[1:])
        reaches = most if reaches_rad is None else np.minimum(reaches_rad, most)
        return cls(points_rad=points, marks_rad=marks, reaches_rad=reaches)

    @property
    def length_rad(self) -> float:
        """Length of the polyline."""
        return float(self.marks_rad[-1])

    def at(self, s_rad: Array) -> Array:
        """Return position and derivatives (4, N, n) at distances (N,)."""
        found: Array = path_at(self.points_rad, self.marks_rad, self.reaches_rad, s_rad)
        return found

    def corner(self, index: int, spacing_rad: float) -> Array:
        """Return samples (k, n) of the rounding of an inner corner."""
        reach = float(self.reaches_rad[index])
        count = max(3, int(np.ceil(2.0 * reach / spacing_rad)) + 1)
        return np.asarray(self.at(self.marks_rad[index] + reach * np.linspace(-1.0, 1.0, count))[0])

    def with_reach(self, index: int, reach_rad: float) -> SmoothPath:
        """Return the path with another rounding of one corner."""
        reaches = self.reaches_rad.copy()
        reaches[index] = reach_rad
        return SmoothPath(points_rad=self.points_rad, marks_rad=self.marks_rad, reaches_rad=reaches)


def _without_repeats(points: Array) -> Array:
    keep = np.concatenate([[True], np.max(np.abs(np.diff(points, axis=0)), axis=1) > SHORTEST_RAD])
    keep[-1] = True
    if len(points) > 2 and np.max(np.abs(points[keep][-1] - points[keep][-2])) <= SHORTEST_RAD and keep.sum() > 2:
        keep[np.flatnonzero(keep)[-2]] = False
    return np.asarray(points[keep])
