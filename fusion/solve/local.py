"""The local solve: from a start to the nearest minimum of E, with covariance and unobservable motions (eqs 11, 12)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.batch import Batch, pack
from fusion.measurement import Measurement
from fusion.solve.observability import FreeDirection, covariance_and_freedom
from fusion.solve.placement import place
from fusion.solve.polish import solve_from
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose

MIN_SIZE_M = 0.05  # smallest size of an object, even if its features are closer together


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalSolution:
    """A minimum of the error over all given measurements.

    Attributes:
        rotation, translation_m: the pose, base_from_object, (3, 3) and (3,).
        covariance: 6x6, translation then rotation, base axes, m and rad; free directions have 10 object sizes or rad.
        information: 6x6 in the same order.
        values: (N,) exact local pose functions, the prior's share last if there was one.
        chi_square: their sum, E.
        dof: degrees of freedom of E: constraints minus observed unknowns.
        unobservable: motions that the measurements leave free.
    """

    rotation: Array
    translation_m: Array
    covariance: Array
    information: Array
    values: Array
    chi_square: float
    dof: int
    unobservable: tuple[FreeDirection, ...]

    @property
    def base_from_object(self) -> RigidTransform:
        """The pose."""
        return RigidTransform.from_components(self.translation_m, Rotation.from_matrix(self.rotation))


def solve(
    measurements: Sequence[Measurement], start: RigidTransform, *, prior: UncertainPose | None = None
) -> LocalSolution:
    """Return the minimum of E = sum f_i near `start`; uses every measurement.

    Raises:
        InvalidRequest: a measurement is invalid, or there is none.
    """
    if not len(measurements) and prior is None:
        raise InvalidRequest("no measurement to fuse", hint="give at least one measurement or a prior pose")
    b, pose = pack(measurements, prior), start.as_matrix()
    return local_solution(b, np.ones(len(b.cls)), pose[:3, :3], pose[:3, 3])


def solve_from_many(
    measurements: Sequence[Measurement],
    *,
    starts: int = 64,
    seed: int = 0,
    prior: UncertainPose | None = None,
) -> LocalSolution:
    """Return the best of several local solves from random rotations: least squares over all measurements (paper, 1990).

    Raises:
        InvalidRequest: a measurement is invalid, or there is none.
    """
    if not len(measurements):
        raise InvalidRequest("no measurement to fuse", hint="give at least one measurement")
    b = pack(measurements, prior)
    use = np.ones(len(b.cls))
    found = [_started(b, use, R) for R in Rotation.random(starts, rng=np.random.default_rng(seed)).as_matrix()]
    return min(found, key=lambda s: s.chi_square)


def _started(b: Batch, use: Array, rotation: Array) -> LocalSolution:
    t = np.zeros(3)
    place(b, use, rotation, t)
    return local_solution(b, use, rotation, t)


def local_solution(b: Batch, use: Array, rotation: Array, translation_m: Array, *, far: bool = True) -> LocalSolution:
    """Return the solution as `solve` does, for packed measurements with `use` (N,) > 0; arguments stay unchanged."""
    n = len(b.cls)
    # C order, because numba compiles everything again for any other layout.
    R, t = np.array(rotation, float, order="C"), np.array(translation_m, float, order="C")
    H, f, gradient, direction = np.zeros((6, 6)), np.zeros(n), np.zeros((n, 6)), np.zeros((n, 3))
    solve_from(b, use, R, t, far, H, f, gradient, direction)
    chosen = use > 0
    covariance, free = covariance_and_freedom(H, *middle_and_size(b, chosen, R))
    return LocalSolution(
        rotation=R,
        translation_m=t,
        covariance=covariance,
        information=H,
        values=f,
        chi_square=float(f[chosen].sum()),
        dof=int(b.dof[chosen].sum()) - 6 + len(free),
        unobservable=free,
    )


def middle_and_size(b: Batch, chosen: NDArray[np.bool_], R: Array) -> tuple[Array, float]:
    """Return the centroid of the chosen features (3,), from the object's origin in base axes, and their spread, m."""
    points = b.m[chosen & (b.cls > 0)]
    if not len(points):
        return np.zeros(3), 1.0
    middle = np.add.reduce(points) / len(points)
    apart = (points - middle).ravel()
    return R @ middle, max(math.sqrt(apart @ apart / len(points)), MIN_SIZE_M)
