"""Finds the motions of the object that the measurements do not determine, and describes them in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.geometry import skew

FREE_SIGMA = 1.0  # in object sizes or radians: a larger standard deviation means that the motion is not observed
PRIOR_SIGMA = 10.0  # the standard deviation reported for a free direction, in the same unit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeDirection:
    """A motion that the measurements do not observe.

    Attributes:
        words: for people, with the direction in base axes.
        twist: (6,) unit motion (translation of the object's origin, rotation) in base axes, in m and rad.
    """

    words: str
    twist: Array


def covariance_and_freedom(
    information: Array, centre_m: Array, size_m: float
) -> tuple[Array, tuple[FreeDirection, ...]]:
    """Return the 6x6 covariance over (translation, rotation) of the object's origin, and the unobservable motions.

    Free motions get a standard deviation of `PRIOR_SIGMA` radians or object sizes instead of infinity.

    Args:
        information: (6, 6) over translation and rotation in base axes.
        centre_m: (3,) from the object's origin to the centroid of its sensed features, base axes; rotation is about it.
        size_m: spread of those features; it makes metres and radians comparable.
    """
    # A motion (c, r) of the middle moves the origin by c - r x centre = c + [centre]x r.
    origin_from_centre = np.diag([size_m, size_m, size_m, 1.0, 1.0, 1.0])
    origin_from_centre[:3, 3:] = skew(centre_m)
    values, vectors = np.linalg.eigh(origin_from_centre.T @ information @ origin_from_centre)
    free = values < max(FREE_SIGMA**-2, 1e-13 * values[-1])
    variances = np.where(free, PRIOR_SIGMA**2, 1.0 / np.where(free, 1.0, values))
    half = origin_from_centre @ vectors * np.sqrt(variances)
    if not free.any():
        return half @ half.T, ()
    basis = _simple_basis(vectors[:, free])
    return half @ half.T, tuple(_described(c, origin_from_centre, centre_m) for c in basis.T)


def _simple_basis(vectors: Array) -> Array:
    """Return another basis of the same space in which pure translations are separate: reduced by the rotation part."""
    if vectors.shape[1] < 2:
        return vectors
    _, size, turn = np.linalg.svd(vectors[3:])
    rank = int(np.sum(size > 1e-3))
    rotated = vectors @ turn.T
    return np.hstack([rotated[:, rank:], rotated[:, :rank]])


def _described(centred: Array, origin_from_centre: Array, centre_m: Array) -> FreeDirection:
    twist = origin_from_centre @ centred
    shift, turn = twist[:3] - np.cross(centre_m, twist[3:]), twist[3:]
    size = float(np.linalg.norm(turn))
    if size < 0.05 * np.linalg.norm(centred):
        words = f"shift along {_axis(shift)}"
    else:
        axis = turn / size
        slide = float(shift @ axis)
        words = f"turn about {_axis(axis)}"
        if abs(slide) > 0.05 * size:
            words += f" while sliding {1000 * abs(slide) / size * np.pi / 180:.1f} mm per degree"
    return FreeDirection(words=words, twist=twist / np.linalg.norm(twist))


def _axis(v: Array) -> str:
    v = v / max(float(np.linalg.norm(v)), 1e-300)
    v = v * (1.0 if v[np.argmax(np.abs(v))] > 0 else -1.0)
    for k, name in enumerate("xyz"):
        if v[k] > 0.999:
            return f"the base's {name} axis"
    return f"({v[0]:+.2f}, {v[1]:+.2f}, {v[2]:+.2f}) of the base"
