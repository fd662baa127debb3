"""Runs drills through the HTTP API: `python -m benchmarks.drills [--drills 24] [--first 1] [--kind WORDS]`.

Every drill runs one or two deeds on the simulated bench with a fault that the simulator injects: a device that dies or
freezes, a panel that moves, a blocked or missing control, a dark lamp, a cable, a slipped grasp. A drill is right when
the outcome is a typed one of its kind and names its cause, nothing is said to be done that is not, the arm ends away
from the panel, at most 100 N act, and nothing that was not named moves or is touched with more than 10 N.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from scipy.spatial.transform import RigidTransform

from benchmarks.cell import clear_stop, run_to_end
from benchmarks.drill_kinds import BENCH, ROOT, Drill, drill_of
from benchmarks.manipulation import wilson_lower
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.frames import frame_tree
from hal.geometry import identity
from hal.panel import Shown
from hal.simulated import ObjectTruth, Truth
from service.client import Client
from service.evaluate import shown_of, truth_of
from service.serve import Options, Panelwright

LARGEST_N, TOUCHED_N = 100.0, 10.0
AWAY_M = 0.05  # least distance of the finger tips from the plate at the end
FIRST_SEED = 20_000
PASS_RATIO = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """Judgement of one drill; `wrong` lists what was not right."""

    drill: Drill
    seed: int
    outcome: str
    said: str
    peak_n: float
    is_untrue: bool
    wrong: tuple[str, ...]

    def line(self) -> str:
        """Return the drill as one line of text."""
        mark = "UNTRUE" if self.is_untrue else "WRONG" if self.wrong else "right"
        return (
            f"{self.seed:6} {self.drill.kind:24} {self.drill.control:10} {mark:6} {self.outcome:12} {self.peak_n:5.1f} N "
            f"{'; '.join(self.wrong)} | {self.said[:300]}"
        )


def run(number: int) -> Judged:
    """Run and judge one drill in a new service."""
    drill, seed = drill_of(number), FIRST_SEED + number
    with tempfile.TemporaryDirectory(prefix="panelwright-drill-") as folder:
        cell = load_cell(_cell_file(drill, Path(folder)), seed=seed)
        server = Panelwright(cell, Options(port=0, runs_dir=Path(folder) / "runs", inline=True))
        server.start()
        try:
            client = Client(url=server.url, timeout_s=120.0)
            clear_stop(client)
            first = {item.name: item for item in _truth(server).objects}
            asked = [name for name in (drill.deed_first, drill.control) if name is not None]
            tasks = [run_to_end(client, "/v1/manipulate", _body(name, first)) for name in asked]
            return _judge(drill, seed, tasks, _truth(server), _tips(server))
        finally:
            server.close()


def _cell_file(drill: Drill, folder: Path) -> Path:
    bench = ROOT / "cells/bench.toml"
    table: dict[str, Any] = tomllib.loads(bench.read_text(encoding="utf-8"))
    for key in ("panel", "calibrations", "knowledge"):
        table["cell"][key] = str(ROOT / table["cell"][key])
    simulation: dict[str, Any] = {"events": list(drill.events), "cables": list(drill.cables)}
    if drill.friction is not None:
        simulation["pad_friction"] = drill.friction
    table["simulation"] = simulation
    if drill.device_fault is not None:
        device, fault = drill.device_fault
        table["devices"][device].setdefault("options", {})["fault"] = fault
    path = folder / "cell.toml"
    path.write_text(tomlkit.dumps(json.loads(json.dumps(table))), encoding="utf-8")
    return path


def _body(name: str, now: dict[str, ObjectTruth]) -> dict[str, Any]:
    """Return a request that changes a control. The drill may know its present state; the cell has to look."""
    one = BENCH.object(name)
    if one.goal is None:
        raise ValueError(f"{name} cannot be operated")
    other = one.goal.other_than(shown_of(now[one.shown_by]))
    return {"object": name, one.goal.key: other, "confirm": name}


def _truth(server: Panelwright) -> Truth:
    connection = server.service.supervisor.connection
    return truth_of(connection, connection.clock.now_s())


def _tips(server: Panelwright) -> RigidTransform:
    """Return base_from_grip by the arm's own joints."""
    connection = server.service.supervisor.connection
    gripper = connection.cell.names_of(DeviceKind.GRIPPER)[0]
    flange = connection.mover.state().base_from_flange
    return flange * frame_tree(connection.cell, identity()).base_from(gripper).parent_from_child


def _judge(drill: Drill, seed: int, tasks: Sequence[dict[str, Any]], truth: Truth, tips: RigidTransform) -> Judged:
    outcome, said = _told(tasks[-1])
    named = [name for name in (drill.deed_first, drill.control) if name is not None]
    allowed = {*named, *(BENCH.object(name).shown_by for name in named)}
    untrue = [text for name, task in zip(named, tasks, strict=True) if (text := _untrue(name, task, truth))]
    before = {item.name: item for item in truth.initial}
    moved = [
        f"{item.name} moved unasked"
        for item in truth.objects
        if item.name not in allowed
        and not BENCH.object(item.name).is_right(shown_of(before[item.name]), shown_of(item))
    ]
    touched = [
        f"{name} touched with {peak_n:.0f} N"
        for name, peak_n in truth.contact.peaks_n.items()
        if peak_n > TOUCHED_N and name not in allowed and not name.startswith("_")
    ]
    base_from_panel = RigidTransform.from_matrix(truth.base_from_panel_matrix)
    away_m = float(base_from_panel.inv().apply(tips.translation)[2])
    wrong = [*untrue, *moved, *touched]
    if outcome not in drill.outcomes:
        wrong.append(f"outcome {outcome}")
    if outcome != "done" and not any(word in said for word in drill.words):
        wrong.append("cause not named")
    if away_m < AWAY_M:
        wrong.append(f"the tips are {1e3 * away_m:.0f} mm before the plate")
    if truth.contact.peak_n > LARGEST_N:
        wrong.append(f"{truth.contact.peak_n:.0f} N")
    return Judged(
        drill=drill, seed=seed, outcome=outcome, said=said, peak_n=truth.contact.peak_n, is_untrue=bool(untrue),
        wrong=tuple(wrong),
    )  # fmt: skip


def _told(task: dict[str, Any]) -> tuple[str, str]:
    """Return the outcome of a task, and everything that it says about it."""
    if task["result"] is None:
        problem = task["problem"] or {}
        return "error", f"{problem.get('title')}: {problem.get('detail')} {json.dumps(problem.get('details', {}))}"
    action = task["result"]["action"]
    return ("done" if action["confirmed"] else str(action["outcome"])), str(action["detail"])


def _untrue(name: str, task: dict[str, Any], truth: Truth) -> str:
    """Return what a task says to be done and is not, or nothing."""
    if task["result"] is None or not task["result"]["action"]["confirmed"]:
        return ""
    one = BENCH.object(name)
    shown: Shown = shown_of(next(item for item in truth.objects if item.name == one.shown_by))
    target = task["result"]["action"]["target"]
    is_reached = one.goal is not None and one.goal.is_reached(target, shown)
    return "" if is_reached else f"{name} was said to be {target} and is {shown}"


def table(judged: Sequence[Judged]) -> str:
    """Return one row per kind, and the sum."""
    rows = ["| kind | right | untrue | largest force N |", "| --- | --- | --- | --- |"]
    for kind in [*sorted({each.drill.kind for each in judged}), "all"]:
        some = [each for each in judged if kind in (each.drill.kind, "all")]
        right = sum(not each.wrong for each in some)
        rows.append(
            f"| {kind} | {right} of {len(some)} ({wilson_lower(right, len(some)):.2f}) "
            f"| {sum(each.is_untrue for each in some)} | {max(each.peak_n for each in some):.0f} |"
        )
    return "\n".join(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the drills and print; return 1 if fewer than 95 % are right or anything untrue was said."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drills", type=int, default=24)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--kind", default="", help="run only kinds whose name contains this")
    given = parser.parse_args(arguments)
    judged = []
    for number in range(given.first, given.first + given.drills):
        if given.kind in drill_of(number).kind:
            judged.append(run(number))
            print(judged[-1].line(), flush=True)
    print(table(judged))
    right = sum(not each.wrong for each in judged)
    return 0 if right >= PASS_RATIO * len(judged) and not any(each.is_untrue for each in judged) else 1


if __name__ == "__main__":
    np.set_printoptions(precision=3)
    raise SystemExit(main())
