"""Joining pieces of one surface that something in front has parted."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range import bend, fit, rays
from perception.range.finish import FREE, Samples, thinned
from perception.range.noise import NoiseModel
from perception.range.surfaces import PLANE, depth_on, depths_on

Array = NDArray[np.float64]

PAIR_SAMPLES = 150
JOINED_SHARE = 0.85
JOINED_MEAN_SQUARE = 1.6
NEAR_SAMPLES = 16
NEAR_SIGMAS = 20.0
SCRAP_SHARE = 0.1
SCRAP_SIGMAS = 6.0
LARGEST_TURN_RAD = 0.2
SIGHT_SAMPLES = 40
BEHIND_SHARE = 0.15  # more of the sight line than this seen behind the surface: a gap, not an occluder


def join_pieces(
    depth_m: Array,
    packed: Array,
    kinds: list[int],
    parameters: list[Array],
    samples: list[Samples],
    *,
    noise: NoiseModel,
) -> list[int]:
    """For each surface (label k at k - 1) the label that it belongs to after joining, itself when it stays alone.

    Parameters of the surviving labels are updated in place.
    """
    owner = list(range(1, len(kinds) + 1))
    if len(kinds) < 2:
        return owner
    order = sorted(range(len(kinds)), key=lambda k: -samples[k].x.size)
    thin = [thinned(s, PAIR_SAMPLES) for s in samples]
    perspective = bool(packed[0] > 0)
    near = _nearness(kinds, parameters, samples, perspective)
    for position, big in enumerate(order):
        if owner[big] != big + 1:
            continue
        for small in order[position + 1 :]:
            if owner[small] != small + 1 or not near[big, small]:
                continue
            if _is_scrap(kinds, parameters, samples, big=big, small=small, noise=noise, perspective=perspective):
                owner[small] = big + 1
                continue
            joined = _joint_fit(kinds, parameters, thin, big=big, small=small, noise=noise, perspective=perspective)
            if joined is None or _gap_between(depth_m, packed, (kinds[big], joined), thin[big], thin[small]):
                continue
            owner[small] = big + 1
            parameters[big] = joined
            thin[big] = _together(thin[big], thin[small])
    return owner


def _is_scrap(
    kinds: list[int],
    parameters: list[Array],
    samples: list[Samples],
    *,
    big: int,
    small: int,
    noise: NoiseModel,
    perspective: bool,
) -> bool:
    """Whether a small piece lies so close along a large surface that it is only a dent in it, or a bit of its rim."""
    if samples[small].x.size > SCRAP_SHARE * samples[big].x.size:
        return False
    s = thinned(samples[small], PAIR_SAMPLES)
    surface, own = (kinds[big], parameters[big]), (kinds[small], parameters[small])
    if s.x.size and bend.scrap_gain(surface, own, s, samples[small].x.size, noise, perspective) > 0.0:
        return True
    if kinds[big] == PLANE and kinds[small] != PLANE:
        return False
    if kinds[big] == PLANE and float(parameters[big][:3] @ parameters[small][:3]) < np.cos(LARGEST_TURN_RAD):
        return False
    e = np.empty(s.x.size)
    rays.residuals(kinds[big], parameters[big], s.x, s.y, s.z, s.sigma, perspective, e)
    # Rays just outside the outline miss; those that hit decide, when they are the larger part.
    hit = np.isfinite(e)
    return bool(hit.mean() > 0.5 and np.mean(np.abs(e[hit]) < SCRAP_SIGMAS) > JOINED_SHARE)


def _joint_fit(
    kinds: list[int],
    parameters: list[Array],
    thin: list[Samples],
    *,
    big: int,
    small: int,
    noise: NoiseModel,
    perspective: bool,
) -> Array | None:
    kind, th = kinds[big], parameters[big]
    a, b = thin[big], thin[small]
    if kind == PLANE and kinds[small] == PLANE:
        turn = float(th[:3] @ parameters[small][:3])
        if turn < np.cos(LARGEST_TURN_RAD):
            return None
    both = _together(a, b)
    joint, _, _, _, _ = fit.fit_robust(kind, th, both.x, both.y, both.z, both.sigma, perspective, FREE, 3)
    # What a piece leaves over by itself is bend, where noise is slow, and it is no less in the joint surface.
    own = max(_trimmed(kinds[k], parameters[k], thin[k], perspective)[1] for k in (big, small))
    slow = noise.slow_share(float(np.median(both.z)))
    limit = JOINED_MEAN_SQUARE * (1.0 + slow * max(own - 1.0, 0.0))
    for s in (a, b):
        share, mean_square = _trimmed(kind, joint, s, perspective)
        if share < JOINED_SHARE or mean_square > limit:
            return None
    return np.asarray(joint)


def _trimmed(kind: int, th: Array, s: Samples, perspective: bool) -> tuple[float, float]:
    """Share of the samples within the trim, and their mean squared residual in squared sigmas."""
    e = np.empty(s.x.size)
    rays.residuals(kind, th, s.x, s.y, s.z, s.sigma, perspective, e)
    good = e[np.abs(e) < fit.TRIM_SIGMAS]
    return good.size / max(e.size, 1), float(np.mean(good**2)) if good.size else np.inf


def _nearness(
    kinds: list[int], parameters: list[Array], samples: list[Samples], perspective: bool
) -> NDArray[np.bool_]:
    """(n, n) whether surface i, extended, passes near most of piece j: a cheap refusal before the joint fits."""
    few = [thinned(s, NEAR_SAMPLES) for s in samples]
    starts = np.cumsum([0] + [s.x.size for s in few])
    x, y, z, sigma = (np.concatenate([getattr(s, name) for s in few]) for name in ("x", "y", "z", "sigma"))
    return np.asarray(_near_matrix(np.array(kinds), np.stack(parameters), starts, x, y, z, sigma, perspective))


@njit(cache=True)
def _near_matrix(kinds, ths, starts, x, y, z, sigma, perspective):  # type: ignore[no-untyped-def]
    n = kinds.shape[0]
    near = np.zeros((n, n), np.bool_)
    for i in range(n):
        for j in range(n):
            size = starts[j + 1] - starts[j]
            if i == j or size < 4:
                continue
            inside = 0
            for k in range(starts[j], starts[j + 1]):
                zm = depth_on(kinds[i], ths[i], x[k], y[k], perspective)
                if abs(z[k] - zm) < NEAR_SIGMAS * sigma[k]:
                    inside += 1
            near[i, j] = 2 * inside > size
    return near


def _together(a: Samples, b: Samples) -> Samples:
    return Samples(
        x=np.concatenate([a.x, b.x]),
        y=np.concatenate([a.y, b.y]),
        z=np.concatenate([a.z, b.z]),
        sigma=np.concatenate([a.sigma, b.sigma]),
    )


def _gap_between(depth_m: Array, packed: Array, surface: tuple[int, Array], a: Samples, b: Samples) -> bool:
    """Whether the sensor sees past the surface on the shortest line between the two pieces."""
    d2 = (a.x[:, None] - b.x[None, :]) ** 2 + (a.y[:, None] - b.y[None, :]) ** 2
    i, j = np.unravel_index(int(np.argmin(d2)), d2.shape)
    t = np.linspace(0.0, 1.0, SIGHT_SAMPLES)[1:-1]
    x, y = a.x[i] + t * (b.x[j] - a.x[i]), a.y[i] + t * (b.y[j] - a.y[i])
    u = np.clip(np.rint(x * packed[1] + packed[3]).astype(int), 0, depth_m.shape[1] - 1)
    v = np.clip(np.rint(y * packed[2] + packed[4]).astype(int), 0, depth_m.shape[0] - 1)
    seen = depth_m[v, u]
    perspective = bool(packed[0] > 0)
    model = np.empty(x.size)
    depths_on(*surface, x, y, perspective, model)
    slack = 6.0 * float(np.median(a.sigma))
    behind = seen > model + np.maximum(slack, 3.0 * np.abs(seen) / packed[1] if perspective else 3.0 / packed[1])
    return bool(np.mean(behind) > BEHIND_SHARE)
