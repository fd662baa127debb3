"""Other methods on the same measurements: plain least squares over all of them, and gtsam on the same residuals."""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.fusion_problems import codes, is_near
from benchmarks.fusion_reference import residual
from benchmarks.fusion_simulation import problem
from fusion import Measurement
from fusion.solve import solve, solve_from_many
from hal.arrays import Array
from hal.geometry import difference, matrix_of, perturbed, transform

Row = tuple[str, str, str]


def peers(problems: int, rng: np.random.Generator) -> list[Row]:
    """Compare with plain least squares with one bad measurement (the 1990 objective) and with gtsam."""
    near = sum(
        is_near(difference(p.base_from_object, solve_from_many(p.measurements, starts=32).base_from_object))
        for p in (problem(codes(rng, 16), rng, bad=1) for _ in range(problems))
    )
    rows: list[Row] = [("peer: least squares over all, N=16 with 1 bad", "-", f"success {near / problems:.0%}")]
    if find_spec("gtsam") is None:
        return [*rows, ("peer: gtsam", "-", "not installed")]
    apart, ratio = [], []
    for _ in range(problems):
        made = problem([c for c in codes(rng, 40) if c[0] in "12359"][:16], rng)
        start = perturbed(made.base_from_object, rng.normal(0, 0.01, 6))
        started_s = time.perf_counter()
        mine = solve(made.measurements, start)
        middle_s = time.perf_counter()
        theirs = _gtsam(made.measurements, start)
        ratio.append((time.perf_counter() - middle_s) / (middle_s - started_s))
        apart.append(float(np.linalg.norm(difference(theirs, mine.base_from_object)[:3])))
    return [*rows, ("peer: gtsam, Python factors of the exact classes", "-",
                    f"same place within {np.max(apart):.1e} m, time x{np.median(ratio):.0f}")]  # fmt: skip


def _gtsam(measurements: Sequence[Measurement], start: RigidTransform) -> RigidTransform:
    import gtsam

    graph, key = gtsam.NonlinearFactorGraph(), 0

    def factor(m: Measurement) -> Any:
        def error(_: Any, values: Any, jacobians: list[Array] | None) -> Array:
            pose = values.atPose3(key)
            r = residual(m, pose.rotation().matrix(), pose.translation())
            if jacobians is not None:
                jacobians[0] = np.column_stack([_slope(m, pose, axis) for axis in np.eye(6)])
            return r

        rows = m.dof
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), [key], error)

    for m in measurements:
        graph.add(factor(m))
    initial = gtsam.Values()
    initial.insert(key, gtsam.Pose3(gtsam.Rot3(matrix_of(start)), start.translation))
    pose = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize().atPose3(key)
    return transform(pose.rotation().matrix(), pose.translation())


def _slope(m: Measurement, pose: Any, axis: Array) -> Array:
    forward, back = pose.retract(1e-6 * axis), pose.retract(-1e-6 * axis)
    ahead = residual(m, forward.rotation().matrix(), forward.translation())
    return np.asarray((ahead - residual(m, back.rotation().matrix(), back.translation())) / 2e-6)
