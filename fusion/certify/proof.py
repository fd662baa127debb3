"""Proof that no other pose fits better, by semidefinite relaxation.

At frozen covariances E = z^T Q z with z = (1, vec R, t, -R^T t), 16 numbers, for any mixture of the nine classes and
any number of measurements (`lifted`). Shor's relaxation replaces z z^T by a positive semidefinite Z under 29 quadratic
constraints that every pose fulfils. If the optimal Z has rank one, it is a pose, and no pose is better. In most cases
the multipliers that prove this follow from the pose itself (`dual`); otherwise clarabel (the `certify` extra) solves
the relaxation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.batch import Batch
from fusion.certify.dual import minimiser
from fusion.certify.lifted import lift
from fusion.certify.relaxation import SIZE, nearest_pose, relaxed
from fusion.solve.local import LocalSolution, middle_and_size
from hal.arrays import Array
from hal.geometry import difference, transform

TIGHT_GAP = 1e-3
AGREES_SIGMAS = 1.0  # freezing the covariances moves the minimum by a small part of a standard deviation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate:
    """Result of the relaxation for a pose.

    Attributes:
        tight: the relaxation is a pose, and it is the given one: no pose fits these measurements better.
        gap: ratio of the second to the first eigenvalue of Z; rank one when (almost) zero, 0 where multipliers prove it.
        lower_bound: no pose has a smaller error over these measurements, at the covariances of the given pose.
        value: the error of the given pose, at the same covariances.
        distance_sigmas: Mahalanobis distance between the given pose and that of the relaxation.
        base_from_object: the pose of the relaxation.
    """

    tight: bool
    gap: float
    lower_bound: float
    value: float
    distance_sigmas: float
    base_from_object: RigidTransform


def certificate(b: Batch, used: NDArray[np.bool_], local: LocalSolution) -> Certificate:
    """Bound the error of the used entries of `b` (N,) from below, and compare with the solution `local`.

    Raises:
        Unsupported: the relaxation has to be solved, and clarabel is not installed.
    """
    R, t = local.rotation, local.translation_m
    lever, size = middle_and_size(b, used, R)
    about, middle = R.T @ lever, t + lever  # features are taken from `about`, places from `middle`, in units of `size`
    Q = quadratic_forms(b, R, t, about, middle, size)[used].sum(axis=0)
    scaled_t = (t + R @ about - middle) / size
    z = monomials(R, scaled_t)
    found = minimiser(Q, R, scaled_t)
    rotation, shift, gap, bound = found.rotation, found.translation, 0.0, found.value
    if not found.proven:
        Z, bound = relaxed(Q)
        values, vectors = np.linalg.eigh(Z)
        gap = float(abs(values[-2]) / values[-1])
        rotation, shift = nearest_pose(vectors[:, -1])
    pose = transform(rotation, size * shift + middle - rotation @ about)
    delta = difference(pose, local.base_from_object)
    distance = math.sqrt(max(float(delta @ local.information @ delta), 0.0))
    return Certificate(
        tight=gap < TIGHT_GAP and distance < AGREES_SIGMAS,
        gap=gap,
        lower_bound=bound,
        value=float(z @ Q @ z),
        distance_sigmas=distance,
        base_from_object=pose,
    )


def quadratic_forms(b: Batch, R: Array, t: Array, about: Array, middle: Array, size: float) -> Array:
    """Return (N, 16, 16) forms with z^T Q_i z = error of each entry, covariance frozen at R, t; see `lifted.lift`."""
    forms = np.empty((len(b.cls), SIZE, SIZE))
    lift(b, np.array(R, order="C"), np.array(t, order="C"), np.array(about), np.array(middle), size, forms)
    return forms


def monomials(R: Array, t: Array) -> Array:
    """Return z (16,) of a pose: 1, R row by row, t, -R^T t."""
    return np.concatenate([[1.0], R.ravel(), t, -R.T @ t])
