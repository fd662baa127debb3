"""Computes the exact local pose functions of measurements at a pose (paper eqs 10-13, Fig. 12).

`f(X) = min over Y of g(Y)` under the constraint of the class. The compiled code is in `exact`. At the true pose f has a
chi-square distribution with `Measurement.dof` degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.batch import Batch, pack
from fusion.distance.exact import evaluate
from fusion.measurement import Measurement
from hal.arrays import Array
from hal.geometry import matrix_of


def local_values(measurements: Sequence[Measurement], base_from_object: RigidTransform) -> Array:
    """Return (N,) exact local pose functions f_i at a pose, without unit.

    Raises:
        InvalidRequest: a measurement is invalid; see `fusion.batch.pack`.
    """
    return local_values_and_gradients(measurements, base_from_object)[0]


def local_values_and_gradients(
    measurements: Sequence[Measurement], base_from_object: RigidTransform
) -> tuple[Array, Array]:
    """Return f (N,) and its gradients (N, 6) over (translation, rotation) in base axes, 1/m and 1/rad.

    The gradients follow from the envelope theorem, because the sensed feature is already at its optimum.

    Raises:
        InvalidRequest: a measurement is invalid.
    """
    b = pack(measurements)
    f, gradients, _ = batch_values(b, matrix_of(base_from_object), np.array(base_from_object.translation))
    return f, gradients


def batch_values(b: Batch, R: Array, t: Array) -> tuple[Array, Array, Array]:
    """Return f (N,), gradients (N, 6) and best sensed directions (N, 3) of packed measurements; zero for a prior."""
    n = len(b.cls)
    f, gradients, directions = np.zeros(n), np.zeros((n, 6)), np.zeros((n, 3))
    evaluate(b, np.array(R, order="C"), np.array(t, order="C"), True, f, gradients, directions)
    return f, gradients, directions


def local_value(measurement: Measurement, base_from_object: RigidTransform) -> float:
    """Return `local_values` of one measurement.

    Raises:
        InvalidRequest: the measurement is invalid.
    """
    return float(local_values([measurement], base_from_object)[0])
