"""Measures transfers among the objects of random panels, with every simulated arm.

`python -m benchmarks.transfers [--first SEED] [--transfers N] [--peers RUNS] [--of EVERY]`

A tour goes from the parking position to standoffs above random objects of a panel, with the fingers at a random turn, and
to views of it. As in `manipulation.skills.travel`, a goal is a pose: the nearest joint vectors are searched for quickly, and
then thoroughly, until there is a path to one. The next transfer begins there. Before every second panel two cables hang, as
a range image shows them. Plans are judged by a check every 5 mrad. With `--peers` every `EVERY`-th transfer is also planned
by OMPL (RRT-Connect and its simplifier, RUNS seeds), and all are timed by TOPP-RA; this needs `pip install ompl==2.0.1
toppra`.
Times are CPU times of one thread.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.behind_cables import drawn_cable
from hal.arrays import Array
from hal.config import load_cell
from hal.errors import Unreachable
from hal.geometry import perturbed, transform_rpy
from hal.panel import Panel, Shown
from hal.strict import validate
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.collision import RECHECK_RAD, CollisionModel, placed
from manipulation.planning.hand import Hand
from manipulation.planning.shapes import CollisionBox, floor_box, panel_boxes
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.planning.transfer import QUICK, THOROUGH, TransferPlanner
from manipulation.skills.context import panel_from_grip
from manipulation.skills.travel import CLEAR_M, clear_goals, near_first
from perception.range import find_obstacles
from service.sweep.draw import draw_panel
from simbackend.arm_model import MODELS

ROOT = Path(__file__).resolve().parents[1]
CELLS = {"t3": "bench", "ur10e": "ur10e", "panda": "panda"}
LEGS = 8  # of a tour
STANDOFF_M, VIEW_M, WIDTH_M = 0.03, 0.25, 0.02
PITCH_M = 0.006
SPREAD = np.array([0.06] * 3 + [0.14] * 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Leg:
    """One transfer: its planner, start (n,) rad, and the joint vectors of its goal, nearest first."""

    arm: str
    seed: int
    planner: TransferPlanner
    start_rad: Array
    goals_rad: list[Array]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planned:
    """Result for one transfer: CPU milliseconds, path length in joint space, duration; no length if it failed.

    `goal_rad` (n,) is where the path ends, and the nearest goal if there is none.
    """

    leg: Leg
    goal_rad: Array
    plan_ms: float
    length_rad: float
    duration_s: float
    is_free: bool
    is_straight: bool
    path_rad: Array


def tour(arm: str, seed: int) -> Iterator[Planned]:
    """Plan the transfers of one tour over a random panel, and yield the results."""
    cell = load_cell(ROOT / "cells" / f"{CELLS[arm]}.toml").file
    rng = np.random.default_rng([seed, 20])
    panel = validate(draw_panel(seed).stated, Panel, source=f"random panel {seed}")
    base_from_panel = perturbed(
        transform_rpy(cell.workspace.panel_position_m, cell.workspace.panel_rpy_rad), rng.uniform(-SPREAD, SPREAD)
    )
    grip = RigidTransform.from_translation([0.0, 0.0, 0.21])
    kinematics = Kinematics.of(MODELS[arm]().capabilities)
    shown = {one.name: Shown(state=state) for one in panel.objects for state in one.states_shown[:1]}
    boxes = (
        floor_box(cell.workspace.floor_z_m),
        *placed((*panel_boxes(panel, shown), *(_cables(panel, rng) if seed % 2 else ())), base_from_panel),
    )
    model = CollisionModel.build(kinematics, Hand().capsules(grip, WIDTH_M)).with_boxes(boxes)
    limits = SpeedLimits(tip_m_per_s=cell.safety.speed_limit_m_per_s)
    planner = TransferPlanner(model=model, flange_from_tool=grip, limits=limits, seed=seed)
    here = np.asarray(cell.workspace.park_rad)
    for _ in range(LEGS):
        pose = _place(panel, rng)
        goals = clear_goals(model, base_from_panel * pose * grip.inv(), here)
        if goals and model.is_clear(here, margin_m=CLEAR_M):
            leg = Leg(arm=arm, seed=seed, planner=planner, start_rad=here, goals_rad=list(near_first(goals, here)))
            yield (row := planned(leg))
            here = row.goal_rad


def _cables(panel: Panel, rng: np.random.Generator) -> Iterator[CollisionBox]:
    """Yield the boxes that a range image gives of two random cables."""
    half = (panel.width_m / 2, panel.height_m / 2)
    ends = [np.array(drawn_cable(rng, half).path_m) for _ in range(2)]
    axes = np.vstack([np.linspace(a, b, 60) for path in ends for a, b in itertools.pairwise(path)])
    x, y = np.meshgrid(*(np.linspace(-side, side, 50) for side in half))
    seen = np.vstack(
        [axes + rng.normal(0.0, 0.002, axes.shape), np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()])]
    )
    for one in find_obstacles(seen, panel, pitch_m=PITCH_M, sigma_m=0.0006):
        yield CollisionBox(name="cable", parent_from_box=one.panel_from_box, half_m=one.half_m)


def _place(panel: Panel, rng: np.random.Generator) -> RigidTransform:
    """Return panel_from_grip above a random object, or one in four times further away as for a view."""
    one = panel.objects[rng.integers(len(panel.objects))]
    height = one.envelope().height_m + (VIEW_M if rng.random() < 0.25 else STANDOFF_M)
    return panel_from_grip((*one.position_m, height), float(rng.uniform(-np.pi, np.pi)))


def planned(leg: Leg) -> Planned:
    """Plan one transfer and check it."""
    began_s = time.thread_time()
    motion, goal = None, leg.goals_rad[0]
    for effort, goal in itertools.product((QUICK, THOROUGH), leg.goals_rad):
        with suppress(Unreachable):
            motion = leg.planner.plan(leg.start_rad, goal, effort=effort)
            break
    spent_ms = 1e3 * (time.thread_time() - began_s)
    if motion is None:
        return Planned(
            leg=leg, goal_rad=leg.goals_rad[0], plan_ms=spent_ms, length_rad=np.nan, duration_s=np.nan, is_free=False,
            is_straight=False, path_rad=np.array([leg.start_rad, leg.goals_rad[0]]),
        )  # fmt: skip
    q, model = motion.positions_rad, leg.planner.model
    free = all(model.free_fraction(a, b, margin_m=0.0, step_rad=RECHECK_RAD) == 1.0 for a, b in itertools.pairwise(q))
    length = float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    apart = float(np.linalg.norm(goal - leg.start_rad))
    return Planned(
        leg=leg, goal_rad=goal, plan_ms=spent_ms, length_rad=length, duration_s=float(motion.times_s[-1]), is_free=free,
        is_straight=length < 1.0001 * apart, path_rad=q,
    )  # fmt: skip


def transfers(first: int, count: int) -> list[Planned]:
    """Plan the first `count` transfers of tours with all arms in turn."""
    out: list[Planned] = []
    for seed in itertools.count(first):
        for arm in CELLS:
            out += tour(arm, seed)
        if len(out) >= count:
            return out[:count]
    return out


def table(rows: list[Planned]) -> str:
    """Return one line for each arm."""
    lines = ["| arm | transfers | solved | free every 5 mrad | straight | plan p50, p99 ms |", "| --- |" + " --- |" * 5]
    for arm in (*CELLS, "all"):
        some = [row for row in rows if arm in (row.leg.arm, "all")]
        solved = [row for row in some if np.isfinite(row.length_rad)]
        median, high = np.quantile([row.plan_ms for row in some], [0.5, 0.99])
        lines.append(
            f"| {arm} | {len(some)} | {len(solved)} | {sum(row.is_free for row in solved)} | "
            f"{sum(row.is_straight for row in solved)} | {median:.1f}, {high:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--transfers", type=int, default=200)
    parser.add_argument("--peers", type=int, default=0, metavar="RUNS", help="runs of OMPL for each compared transfer")
    parser.add_argument("--of", type=int, default=4, metavar="EVERY", help="compare every so many transfers with OMPL")
    options = parser.parse_args()
    transfers(options.first, 2)  # loads the compiled loops
    rows = transfers(options.first, options.transfers)
    print(table(rows), flush=True)
    if options.peers:
        from benchmarks.transfers_peers import against_ompl, against_toppra

        print(against_toppra(rows), flush=True)
        print(against_ompl(rows[:: options.of], options.peers), flush=True)


if __name__ == "__main__":
    main()
