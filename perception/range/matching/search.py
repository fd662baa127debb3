"""Local search: refine the hypotheses of a model and keep the few poses that explain the image best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from perception.range.matching.hypotheses import Candidate, Piece, hypotheses
from perception.range.matching.models import ComponentModel, MotionKind
from perception.range.matching.verify import View, climbed

FEW_PIXELS, MANY_PIXELS = 400, 4000  # pixels of a model: every one is used below the first, one in nine from the second
STARTS = 24  # hypotheses refined per model, plus a quarter of the number of pieces
SMALL_STARTS = 120  # for a model of few pixels, which is cheap to try and easily outranked by poses behind occluders
FINE_STARTS = 6  # plus an eighth of the number of pieces
WORST_START = -45.0  # a lower score is dropped; adapting the sizes can gain about this much
APART_M, APART_RAD = 0.008, 0.1  # two hypotheses with smaller differences count as one
SAME_PLACE_M = 0.005  # the same after coarse refinement, whatever the rotation
COARSE_M, COARSE_RAD, COARSE_LEVELS = 0.006, 0.12, 3  # coarse search: first steps, and number of step sizes
FINE_M, FINE_RAD, FINE_LEVELS = 0.0012, 0.03, 4  # the same for the fine search
GROWTH_STEP = 0.4  # first step of a surface's size, relative to its tolerance
GROWING_FROM_M = 0.0015  # sizes with a smaller tolerance are not adapted, because the data cannot resolve them
UPRIGHT = 0.5  # a motion axis with a larger z component is perpendicular to the panel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Try:
    """A hypothesis with its score: a model at `q` = (x, y, yaw, state, size change of each surface), panel frame."""

    candidate: Candidate
    q: Array
    score: float


def tries_of(candidate: Candidate, pieces: list[Piece], view: View) -> list[Try]:
    """Return the best poses of one model, refined with coarse steps on a subset of the pixels (see `_stride`)."""
    growth = np.zeros(len(candidate.solid.rows))
    stride = _stride(candidate, view)
    quick = [
        climb(candidate, np.concatenate([h, growth]), view, stride=stride)
        for piece in pieces
        for h in hypotheses(candidate, piece)
    ]
    coarse = []
    starts = SMALL_STARTS if stride == 1 else STARTS + len(pieces) // 4
    for t in _apart(quick, APART_M, APART_RAD, starts):
        ways = ways_of(candidate.model, t.q, COARSE_M, COARSE_RAD)
        coarse.append(climb(candidate, t.q, view, ways=ways, levels=COARSE_LEVELS, stride=stride))
    apart = _apart(coarse, SAME_PLACE_M, np.pi, FINE_STARTS + len(pieces) // 8)
    return [t for t in apart if t.score > WORST_START]


def _stride(candidate: Candidate, view: View) -> int:
    """Return the pixel stride that is fine enough to tell good hypotheses from bad ones."""
    size = candidate.travel[:, 1].max(axis=0) - candidate.travel[:, 0].min(axis=0)
    depth = float(view.p[2]) if view.packed[0] > 0 else 1.0
    pixels = float(size[0] * size[1]) * (view.packed[1] / depth) * (view.packed[2] / depth)
    return 1 if pixels < FEW_PIXELS else 2 if pixels < MANY_PIXELS else 3


def _apart(tries: list[Try], apart_m: float, apart_rad: float, most: int) -> list[Try]:
    """Return at most `most` tries, best first, without those whose pose is close to that of a better one."""
    ranked = sorted(tries, key=lambda t: -t.score)
    q = np.array([t.q[:4] for t in ranked]).reshape(-1, 4)
    is_open = np.ones(len(ranked), np.bool_)
    kept: list[Try] = []
    while is_open.any() and len(kept) < most:
        best = int(is_open.argmax())
        kept.append(ranked[best])
        off = np.abs(q - q[best])
        is_open &= (off[:, 0] + off[:, 1] + off[:, 3] >= apart_m) | (off[:, 2] >= apart_rad)
    return kept


def refined(t: Try, view: View) -> Try:
    """Refine pose and surface sizes with fine steps, on every pixel."""
    ways = np.concatenate([ways_of(t.candidate.model, t.q, FINE_M, FINE_RAD), growths_of(t.candidate, t.q.size)])
    return climb(t.candidate, t.q, view, ways=ways, levels=FINE_LEVELS)


def growths_of(candidate: Candidate, size: int) -> Array:
    """Return search steps (M, `size`), one for each surface size that may differ between components of a model."""
    tolerance = candidate.solid.tolerance_m
    growing = np.flatnonzero(tolerance >= GROWING_FROM_M)
    out = np.zeros((len(growing), size))
    out[np.arange(len(growing)), 4 + growing] = GROWTH_STEP * tolerance[growing]
    return out


def ways_of(model: ComponentModel, q: Array, step_m: float, step_rad: float) -> Array:
    """Return search steps (M, 4 + S) of a hypothesis: shifts along and across the object, rotation, and state.

    The last step, for a part that slides along the panel, moves the body and leaves that part where it is.
    """
    c, s = np.cos(q[2]), np.sin(q[2])
    ways = [[step_m * c, step_m * s, 0.0, 0.0], [-step_m * s, step_m * c, 0.0, 0.0]]
    if model.turns:
        ways.append([0.0, 0.0, step_rad, 0.0])
    if model.motion == MotionKind.SLIDE:
        x, y, z = model.motion_axis
        ways.append([0.0, 0.0, 0.0, step_m])
        if abs(z) < UPRIGHT:
            ways.append([step_m * (c * x - s * y), step_m * (s * x + c * y), 0.0, -step_m])
    out = np.zeros((len(ways), q.size))
    out[:, :4] = ways
    return out


def climb(
    candidate: Candidate, q: Array, view: View, *, ways: Array | None = None, levels: int = 0, stride: int = 0
) -> Try:
    """Return the best hypothesis near `q`; with a `stride` only every `stride`-th pixel counts, and the rim does not."""
    model, solid = candidate.model, candidate.solid
    low, high = np.full(q.size, -np.inf), np.full(q.size, np.inf)
    if model.motion == MotionKind.SLIDE:
        slack = max(s.tolerance_m for s in model.surfaces) if abs(model.motion_axis[2]) > UPRIGHT else 0.0
        low[3], high[3] = model.low - slack, model.high + slack
    low[4:], high[4:] = -solid.tolerance_m, solid.tolerance_m
    moved = q.copy()
    steps = np.zeros((0, q.size)) if ways is None else ways
    score = climbed(solid, moved, view, steps, low, high, levels, max(stride, 1), stride == 0)
    return Try(candidate=candidate, q=moved, score=score)
