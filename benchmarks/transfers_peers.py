"""Compares transfers with OMPL and TOPP-RA, which are optional; see `benchmarks.transfers`.

OMPL's validity check is ours, at the same margin and spacing, so that only search and simplification differ.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from hal.arrays import Array
from manipulation.control.setpoint import flange_matrix
from manipulation.planning import timing_kernels
from manipulation.planning.smooth_path import SmoothPath
from manipulation.planning.time_parameterization import timed

if TYPE_CHECKING:
    from benchmarks.transfers import Planned

PLAN_S = 5.0
POINTS = 400
STEP_RAD = 0.02


def against_toppra(rows: Sequence[Planned]) -> str:
    """Return the ratio of our durations to TOPP-RA's on the same path, without a limit of the jerk there."""
    ratios = [ratio_to_toppra(row) for row in rows if np.isfinite(row.length_rad)]
    median, high = np.quantile(ratios, [0.5, 0.99])
    return f"duration against TOPP-RA: median {median:.3f}, p99 {high:.3f}, largest {max(ratios):.3f} of {len(ratios)}"


def ratio_to_toppra(row: Planned) -> float:
    """Return our duration on a path of straight legs and rounded corners over TOPP-RA's."""
    toppra = import_module("toppra")
    planner, kinematics = row.leg.planner, row.leg.planner.model.kinematics
    path = _corners_of(row.path_rad)
    limits = planner.limits.of_joints(kinematics)
    ours = timed(kinematics, path, flange_from_tool=planner.flange_from_tool, limits=planner.limits, name="ours")
    grid, step = np.linspace(0.0, path.length_rad, POINTS, retstep=True)
    tip = timing_kernels.tip_ways(kinematics.dh, path.at(grid), flange_matrix(planner.flange_from_tool))

    class Geometry(toppra.interpolator.AbstractGeometricPath):  # type: ignore[misc, name-defined]  # toppra has no types
        dof = property(lambda _: len(limits[0]))
        path_interval = property(lambda _: np.array([0.0, path.length_rad]))
        waypoints = property(lambda _: None)

        def __call__(self, s: Any, order: int = 0) -> Array:
            return np.asarray(path.at(np.atleast_1d(np.asarray(s, float)))[order])

    def speeds(s: float) -> Array:
        slope = np.abs(path.at(np.array([s]))[1, 0])
        fastest = planner.limits.tip_m_per_s / (tip[min(round(s / float(step)), POINTS - 1)] + 1e-9)
        most = np.minimum(limits[0], slope * fastest + 1e-9)
        return np.stack([-most, most], axis=1)

    bounds = [
        toppra.constraint.JointVelocityConstraintVarying(speeds),
        toppra.constraint.JointAccelerationConstraint(np.stack([-limits[1], limits[1]], axis=1)),
    ]
    solver = toppra.algorithm.TOPPRA(bounds, Geometry(), gridpoints=grid, solver_wrapper="seidel")
    _, speed, _ = solver.compute_parameterization(0.0, 0.0)
    fastest_s = float(np.sum(2.0 * np.diff(grid) / (speed[1:] + speed[:-1])))
    return float(ours.times_s[-1]) / fastest_s


def _corners_of(path_rad: Array) -> SmoothPath:
    """Return a path of straight legs along samples (M, n): the samples where the direction has turned."""
    moved = np.linalg.norm(np.diff(path_rad, axis=0), axis=1)
    keep, last = [0], 0
    for k in range(1, len(path_rad) - 1):
        chord, ahead = path_rad[k] - path_rad[last], path_rad[k + 1] - path_rad[k]
        if moved[k] < 1e-6 or np.linalg.norm(chord) < 0.1:
            continue
        cosine = chord @ ahead / (np.linalg.norm(chord) * np.linalg.norm(ahead))
        if cosine < np.cos(0.1):
            keep, last = [*keep, k], k
    return SmoothPath.of(path_rad[[*keep, len(path_rad) - 1]])


def against_ompl(rows: Sequence[Planned], runs: int) -> str:
    """Return OMPL's CPU times and how long our paths are against the best of its runs."""
    ratios, searched, simplified, solved, tried = [], [], [], 0, 0
    for row in rows:
        lengths = []
        for _ in range(runs):
            found, search_ms, simplify_ms = _ompl(row)
            tried += 1
            searched.append(search_ms)
            if found is not None:
                solved += 1
                simplified.append(simplify_ms)
                lengths.append(found)
        if lengths and np.isfinite(row.length_rad):
            ratios.append(row.length_rad / min(lengths))
    ours = np.quantile([row.plan_ms for row in rows], [0.5, 0.99])
    search, simplify = np.quantile(searched, [0.5, 0.99]), np.quantile(simplified, [0.5, 0.99])
    return (
        f"{len(rows)} transfers, {runs} runs of OMPL each: it solves {solved} of {tried}; search p50 {search[0]:.0f}, p99 "
        f"{search[1]:.0f} ms; simplify {simplify[0]:.0f}, {simplify[1]:.0f} ms; ours with timing {ours[0]:.0f}, {ours[1]:.0f} "
        f"ms; our path against its best: median {np.median(ratios):.3f}, p99 {np.quantile(ratios, 0.99):.3f}, largest "
        f"{max(ratios):.3f}"
    )


def _ompl(row: Planned) -> tuple[float | None, float, float]:
    """Return the length of a simplified RRT-Connect path (None without one), and CPU milliseconds of both parts."""
    base, geometric, util = (import_module(f"ompl.{name}") for name in ("base", "geometric", "util"))
    util.setLogLevel(util.LogLevel.LOG_NONE)
    planner, ends = row.leg.planner, (row.leg.start_rad, row.goal_rad)
    kinematics, n = planner.model.kinematics, len(row.goal_rad)
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for k in range(n):
        bounds.setLow(k, float(kinematics.lower_rad[k]))
        bounds.setHigh(k, float(kinematics.upper_rad[k]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    margin, model = planner._margin(*ends), planner.model
    setup.setStateValidityChecker(lambda q: model.is_clear(np.array([q[k] for k in range(n)]), margin_m=margin))
    setup.getSpaceInformation().setStateValidityCheckingResolution(STEP_RAD / space.getMaximumExtent())
    start, goal = space.allocState(), space.allocState()
    for k in range(n):
        start[k], goal[k] = float(ends[0][k]), float(ends[1][k])
    setup.setStartAndGoalStates(start, goal)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    began_s = time.thread_time()
    setup.solve(PLAN_S)
    search_ms = 1e3 * (time.thread_time() - began_s)
    if not setup.haveExactSolutionPath():
        return None, search_ms, 0.0
    began_s = time.thread_time()
    setup.simplifySolution()
    return float(setup.getSolutionPath().length()), search_ms, 1e3 * (time.thread_time() - began_s)
