"""Covariance of the pose of a match, and the standard deviation of its moving part's state.

Outlines make the likelihood piecewise constant, so it has no curvature at its maximum. The standard deviations are
therefore found by profile likelihood: the shift at which the log-likelihood, maximised over the surface sizes, has
dropped by 2 is two standard deviations.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from perception.range.features import plane_feature
from perception.range.matching.models import MotionKind
from perception.range.matching.search import FINE_M, FINE_RAD, Try, climb, growths_of, ways_of
from perception.range.matching.verify import View
from perception.range.primitives import Surface

FREE_TURN_RAD = np.pi / np.sqrt(3.0)  # standard deviation of an unknown angle: uniform over a full turn
DROP = 2.0  # of the log-likelihood at two standard deviations
SHARES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # tested shifts, relative to a fine step
GROWTH_LEVELS = 2
LEAST_PITCHES = 0.1  # least standard deviation of a position in pixels, because outlines are no sharper


def placed_covariance(t: Try, view: View, base: Surface) -> tuple[Array, float]:
    """Return the covariance (6, 6), translation then rotation in sensor axes, and the state's standard deviation.

    The two shifts in the panel and the rotation about its normal are treated as independent; the covariance of height
    and tilt is that of the panel's plane.
    """
    model = t.candidate.model
    steps = ways_of(model, t.q, FINE_M, FINE_RAD)
    deviations = [_deviation(t, way, view) for way in steps]
    pitch = view.pitch_m
    along, across = (float(np.hypot(d * FINE_M, LEAST_PITCHES * pitch)) for d in deviations[:2])
    reach_m = float(np.abs(t.candidate.travel[..., :2]).max())
    turn = float(np.hypot(deviations[2] * FINE_RAD, LEAST_PITCHES * pitch / reach_m)) if model.turns else FREE_TURN_RAD
    feature = plane_feature(base)
    n = feature.direction
    c, s = np.cos(t.q[2]), np.sin(t.q[2])
    axes = np.stack([view.R @ [c, s, 0.0], view.R @ [-s, c, 0.0]])
    C = np.zeros((6, 6))
    C[:3, :3] = axes.T @ np.diag([along**2, across**2]) @ axes + feature.point_covariance
    # A change of the normal d = w x n is a rotation w about an axis in the panel.
    C[3:, 3:] = np.cross(np.cross(n, feature.direction_covariance, axisb=0).T, n, axisa=1) * -1.0
    C[3:, 3:] = 0.5 * (C[3:, 3:] + C[3:, 3:].T) + turn**2 * np.outer(n, n)
    if model.motion != MotionKind.SLIDE:
        return C, turn
    # Depth measures a motion along the normal; an outline measures a motion along the panel.
    floor = feature.sigma_point_m if abs(model.motion_axis[2]) > 0.5 else LEAST_PITCHES * pitch
    return C, float(np.hypot(deviations[2 + (model.turns > 0)] * FINE_M, floor))


def _deviation(t: Try, way: Array, view: View) -> float:
    """Return the standard deviation along `way`, in units of its length: the larger of those in both directions."""
    growths = growths_of(t.candidate, t.q.size)
    out = 0.0
    for sign in (1.0, -1.0):
        drop, share = 0.0, 0.0
        for share in SHARES:
            moved = climb(t.candidate, t.q + sign * share * way, view, ways=growths, levels=GROWTH_LEVELS)
            drop = t.score - moved.score
            if drop >= DROP:
                break
        out = max(out, share / np.sqrt(2.0 * max(drop, 0.5 * DROP)))
    return out
