"""Pose and dimensions of an object together: Gauss-Newton over 6 + P unknowns on the same residual rows.

Paper section IV: "applicable to problems in which parameterized information is required", such as feature size. The
features of a shape move with its parameters and with the sensed point, so they are computed again at each step. The
derivatives over the pose are those of `distance.rows` (a motion along a tangent changes a distance to second order
only), and those over the parameters are finite differences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.batch import Batch, duplicates, pack
from fusion.distance.rows import whitened_all
from fusion.features import Kind
from fusion.measurement import Measurement, SensingClass
from fusion.robust.answer import FusedPose, ShapeEstimate, weighed
from fusion.shapes import Shape
from fusion.solve.local import LocalSolution, middle_and_size
from fusion.solve.observability import covariance_and_freedom
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, matrix_of, perturbed

CONVERGENCE = 2.0  # factor by which the forgiving weights narrow in each step
FINAL_STEPS = 8
RESTARTS = 6
LARGEST_TURN_RAD = 0.3
DIFFERENCE = 1e-6  # share of a parameter's sigma


def fuse_shape(given: Sequence[Measurement], shape: Shape, prior: UncertainPose) -> FusedPose:
    """Return the pose and the parameters of a shape from measurements of its parts, some of which may be wrong.

    Args:
        given: measurements; those with a `part` follow the shape, others keep their feature.
        shape: the family, with prior values of its parameters.
        prior: a prior pose, good enough to say which side of the object was sensed.

    Raises:
        InvalidRequest: a measurement is invalid or names no part of the shape.
        Contradiction: the inliers could agree by chance.
    """
    repeats = duplicates(given)
    distinct = [i for i in range(len(given)) if i not in repeats]
    measurements = [given[i] for i in distinct]
    everything = np.ones(len(measurements) + 1)
    found = [_descended(measurements, shape, prior, weigh, everything) for weigh in (_level, _forgiving)]
    if not all(made[2].all() for made in found):
        # A precise outlier can distort the dimensions until it fits; a random half of the data often excludes it.
        rng = np.random.default_rng(0)
        for _ in range(RESTARTS):
            half = np.asarray(rng.random(len(everything)) < 0.5, float)
            half[-1] = 1.0
            found.append(_descended(measurements, shape, prior, _forgiving, half))
    pose, values, used, _ = min(found, key=lambda made: made[3])
    b, f, H, _ = _system(measurements, shape, prior, pose, values, np.asarray(used, float))
    local, joint = _local(b, f, H, pose, used, np.asarray(shape.sigma, float))
    found_values, rejected, evidence = weighed(b, used, local, np.array([*distinct, -1]), given, repeats)
    return FusedPose(
        pose=pose,
        covariance=local.covariance,
        chi_square=local.chi_square,
        dof=local.dof,
        values=found_values,
        rejected=rejected,
        unobservable=local.unobservable,
        alternatives=(),
        evidence=evidence,
        shape=ShapeEstimate(names=shape.names, values=values, covariance=joint[6:, 6:]),
    )


def _level(f: Array, gate: Array, scale: float) -> Array:
    """Return Huber's weights: a large residual counts linearly; good where the start causes many large residuals."""
    return np.asarray(np.minimum(1.0, np.sqrt(scale**0.5 * gate / np.maximum(f, 1e-9))))


def _forgiving(f: Array, gate: Array, scale: float) -> Array:
    """Return Geman and McClure's weights, narrowing: a far larger residual stops counting; good with few outliers."""
    return np.asarray((scale * gate / (scale * gate + f)) ** 2)


def _descended(
    measurements: Sequence[Measurement],
    shape: Shape,
    prior: UncertainPose,
    weigh: Callable[[Array, Array, float], Array],
    start_with: Array,
) -> tuple[RigidTransform, Array, NDArray[np.bool_], float]:
    """Return pose, parameters, inliers (N,) and truncated error, by narrowing weights.

    `start_with` (N,): 0 for the measurements that count only at the end.
    """
    pose, values = prior.parent_from_child, np.array(shape.start, float)
    b, f, _, _ = _system(measurements, shape, prior, pose, values, np.zeros(len(measurements) + 1))
    scale = max(float(np.max(f / b.gate)), 1.0)
    weights = start_with * weigh(f, b.gate, scale)
    last = FINAL_STEPS
    while last > 0:
        b, f, H, g = _system(measurements, shape, prior, pose, values, weights)
        step = -np.linalg.solve(H, g)
        step *= min(1.0, LARGEST_TURN_RAD / max(float(np.linalg.norm(step[3:6])), 1e-12))
        pose, values = perturbed(pose, step[:6]), values + step[6:]
        if scale > 1.0:
            scale = max(scale / CONVERGENCE, 1.0)
            weights = start_with * weigh(f, b.gate, scale)
            continue
        last = 0 if step @ H @ step < 1e-8 else last - 1
        weights = np.asarray(f < b.gate, float)
        weights[-1] = 1.0  # the prior pose says which side was sensed, so it is always used
    return pose, values, weights > 0, float(np.minimum(f, b.gate).sum())


def _system(
    measurements: Sequence[Measurement],
    shape: Shape,
    prior: UncertainPose,
    pose: RigidTransform,
    values: Array,
    weights: Array,
) -> tuple[Batch, Array, Array, Array]:
    """Return the batch at these features, f (N,), and the weighted normal equations H (6 + P, 6 + P), g."""
    R, t = np.array(matrix_of(pose), order="C"), np.array(pose.translation, order="C")
    spread = np.asarray(shape.sigma, float)
    b = pack(_placed(measurements, shape, pose, values), prior)
    r, J = _rows(b, R, t)
    slopes = []
    for k, h in enumerate(DIFFERENCE * spread):
        ahead, behind = (
            _rows(pack(_placed(measurements, shape, pose, values + s * h * np.eye(len(values))[k]), prior), R, t)[0]
            for s in (1.0, -1.0)
        )
        slopes.append((ahead - behind) / (2 * h))
    J = np.concatenate([J, np.stack(slopes, axis=2)], axis=2)
    H = np.einsum("i,ikp,ikq->pq", weights, J, J)
    g = np.einsum("i,ikp,ik->p", weights, J, r)
    H[6:, 6:] += np.diag(spread**-2)
    g[6:] += (values - shape.start) / spread**2
    return b, np.sum(r**2, axis=1), H, g


def _placed(
    measurements: Sequence[Measurement], shape: Shape, pose: RigidTransform, values: Array
) -> list[Measurement]:
    """Return the measurements with the features that the shape has at these parameters, near the sensed points."""
    object_from_base = pose.inv()
    made = []
    for i, m in enumerate(measurements):
        if not m.part:
            made.append(m)
            continue
        feature = shape.feature(m.part, values, object_from_base.apply(m.mu_m))
        if m.cls != SensingClass.of(list(Kind)[(m.cls - 1) // 3], feature.kind):
            raise InvalidRequest(
                f"measurement {i} is {m.cls.words}, but part {m.part!r} is a {feature.kind}",
                hint="make it with the part's own feature", index=i, reason="wrong class",
            )  # fmt: skip
        made.append(replace(m, x_m=feature.point_m, u=feature.direction))
    return made


def _rows(b: Batch, R: Array, t: Array) -> tuple[Array, Array]:
    """Return the whitened residuals (N, 6) and Jacobians (N, 6, 6) of a batch."""
    n = len(b.cls)
    r, J = np.zeros((n, 6)), np.zeros((n, 6, 6))
    whitened_all(b, R, t, r, J)
    return r, J


def _local(
    b: Batch, f: Array, H: Array, pose: RigidTransform, used: NDArray[np.bool_], sigma: Array
) -> tuple[LocalSolution, Array]:
    """Return the solution for the pose alone, and the covariance (6 + P, 6 + P) of pose and parameters."""
    joint = np.asarray(np.linalg.inv(H), float)
    information = np.linalg.inv(joint[:6, :6])
    fitted = len(sigma) - float(
        np.diag(joint)[6:] @ sigma**-2.0
    )  # parameters determined by the measurements, not by the prior
    R = matrix_of(pose)
    covariance, free = covariance_and_freedom(information, *middle_and_size(b, used, R))
    local = LocalSolution(
        rotation=R, translation_m=np.array(pose.translation), covariance=covariance, information=information, values=f,
        chi_square=float(f[used].sum()), dof=int(b.dof[used].sum()) - 6 - round(fitted), unobservable=free,
    )  # fmt: skip
    return local, joint
