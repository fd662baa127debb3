"""Runs and judges whole missions: `python -m benchmarks.missions [FIRST LAST] [--cell FILE] [--panel FILE] [--twice]`.

Every mission runs through the real server, as by `panelwright demo --seed N --judge`. Prints a table of missions, one of
kinds (readings and actions that were right, wrong, refused or not confirmed) and the pass lines. With `--twice` each runs a
second time in new processes, which must give the same readings, forces, joints and pictures to the last bit.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks.cell import clear_stop, run_to_end
from benchmarks.swept_scanner import SCANNER, WIRES, with_scanner
from hal.arrays import Array
from hal.config import Cell, load_cell
from service.client import Client
from service.serve import Options, Panelwright
from simbackend.draws import Draws
from simbackend.panel_state import build

ROOT = Path(__file__).resolve().parents[1]
PASSING = ("mission", "started", "wall_s")  # of a report: the name with its date, and times on the wall
DEMO = {"file": "demo"}
VALVE_AND_SLIDER = {
    "schema": 1,
    "title": "Open the valve and set the slider",
    "steps": [
        {"kind": "set", "name": "valve", "object": "main_valve", "state": "open"},
        {"kind": "set", "name": "slider", "object": "setpoint", "value": 70.0},
    ],
}
ALONE_S = 17.0  # pass line
HEAD = (
    "| seed | confirmed | judge agrees | pose mm | pose deg | in 95 % | readings right | by surfaces mm "
    "| cell s | wall s | peak N | note |"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Judged mission.

    Attributes:
        places_m: where the simulator built each object, (3,) in the base frame.
        digest: a hash of everything in the report that a repetition must give again.
    """

    seed: int
    report: dict[str, Any]
    places_m: dict[str, Array]
    digest: str

    @property
    def judge(self) -> dict[str, Any]:
        """The judge's verdict."""
        verdict: dict[str, Any] = self.report["judge"]
        return verdict

    @property
    def by_surfaces_m(self) -> dict[str, float | None]:
        """Position error of each object found by its surfaces; None if it was not found."""
        return {
            check["name"]: None
            if check["centre_in_base_m"] is None
            else float(np.linalg.norm(check["centre_in_base_m"] - self.places_m[check["name"]]))
            for check in self.report.get("by_surfaces", [])
        }

    def row(self) -> str:
        """Return a row of the table."""
        v, r = self.judge, self.report
        pose = ("-", "-") if v["pose_error_m"] is None else _pose(v)
        done = f"{sum(a['confirmed'] for a in r['actions'])}/{len(r['actions'])}"
        note = "" if r["problem"] is None else r["problem"]["detail"][:80]
        note += "".join(f" {moved['name']} moved unasked" for moved in v["moved_unasked"])
        found = ", ".join(
            f"{k} {'NOT FOUND' if e is None else f'{1e3 * e:.2f}'}" for k, e in self.by_surfaces_m.items()
        )
        return (
            f"| {self.seed} | {done} | {_yes(v['agrees'])} | {pose[0]} | {pose[1]} | {_yes(v['inside_95'])} "
            f"| {v['readings_right']}/{v['readings_given']} | {found} | {r['cell_s']:.1f} | {r['wall_s']:.1f} "
            f"| {v['peak_force_n']:.0f} | {note} |"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the missions and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=1)
    parser.add_argument("last", type=int, nargs="?", default=20)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    parser.add_argument("--panel", type=Path, help="a panel file other than the cell's own")
    parser.add_argument(
        "--scanner",
        choices=("polar", *WIRES),
        help="a line scanner, simulated or by its driver over an emulated wire, in place of the range camera",
    )
    parser.add_argument("--twice", action="store_true", help="repeat each mission in new processes and compare")
    parser.add_argument(
        "--alone", action="store_true", help="only open the valve and set the slider, and print the times"
    )
    given = parser.parse_args(arguments)
    if given.last < given.first:
        parser.error(f"the seeds {given.first} to {given.last} are none: FIRST comes before LAST")
    if given.alone:
        return alone(given.cell, range(given.first, given.last + 1))
    print(f"{HEAD}\n|{' --- |' * 12}", flush=True)
    runs, others = [], []
    for seed in range(given.first, given.last + 1):
        runs.append(run(seed, given.cell, given.panel, given.scanner))
        print(runs[-1].row(), flush=True)
        if given.twice and run(seed, given.cell, given.panel, given.scanner).digest != runs[-1].digest:
            others.append(seed)
    print(by_kind(runs))
    if given.twice:
        same = f"same bits in new processes: {len(runs) - len(others)} of {len(runs)}"
        print(f"MISSED {same}; not {others}" if others else f"met    {same}")
    return max(summary(runs), int(bool(others)))


def alone(cell: Path, seeds: Sequence[int]) -> int:
    """Open the valve and set the slider in one mission of each seed; print the times, return 1 if the line is missed."""
    told = [run(seed, cell, asked={"mission": VALVE_AND_SLIDER}) for seed in seeds]
    times_s = sorted(sum(step["cell_s"] for step in one.report["steps"] if step["name"] != "overview") for one in told)
    done = sum(bool(one.report["succeeded"]) and one.judge["agrees"] for one in told)
    is_met = done == len(told) and times_s[-1] <= ALONE_S
    print(
        f"{'met   ' if is_met else 'MISSED'} valve and slider alone: {done} of {len(told)} right, {times_s[0]:.1f} to "
        f"{times_s[-1]:.1f} s on the cell's clock from the first image to the parked arm, median {np.median(times_s):.1f}"
    )
    return int(not is_met)


def run(
    seed: int, cell: Path, panel: Path | None = None, scanner: str | None = None, asked: dict[str, Any] = DEMO
) -> Run:
    """Run and judge one mission in a new service."""
    with tempfile.TemporaryDirectory() as folder:
        is_own = panel is None and scanner is None
        loaded = load_cell(cell if is_own else changed(cell, panel, scanner, Path(folder)), seed=seed)
        panelwright = Panelwright(loaded, Options(port=0, runs_dir=Path(folder)))
        panelwright.start()
        try:
            client = Client(url=panelwright.url, timeout_s=120.0)
            clear_stop(client)
            run_to_end(client, "/v1/missions", asked)
            name = client.get("/v1/missions")["missions"][0]["name"]
            run_to_end(client, "/v1/judge", {"mission": name})
        finally:
            panelwright.close()
        report = json.loads((Path(folder) / name / "report.json").read_text(encoding="utf-8"))
        return Run(
            seed=seed, report=report, places_m=built_places(loaded, seed), digest=digest_of(Path(folder) / name, report)
        )


def digest_of(folder: Path, report: dict[str, Any]) -> str:
    """Return a hash of a mission's report and files without its name and the times on the wall."""
    told = json.dumps(_lasting(report), sort_keys=True)
    files = sorted(path for path in folder.iterdir() if path.suffix == ".png")
    parts = [told.encode(), *(path.name.encode() + path.read_bytes() for path in files)]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def _lasting(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lasting(item) for key, item in value.items() if key not in PASSING}
    return [_lasting(item) for item in value] if isinstance(value, list) else value


def changed(cell: Path, panel: Path | None, scanner: str | None, folder: Path) -> Path:
    """Write a cell file that has another panel or line scanner, into `folder`, and return its path."""
    loaded = load_cell(cell)
    table = tomllib.loads(cell.read_text(encoding="utf-8"))
    table["cell"] |= {
        "panel": str((panel or loaded.panel_path).resolve()),
        "calibrations": str(loaded.calibration_path("any").parent.resolve()),
    }
    if loaded.knowledge_path is not None:
        table["cell"]["knowledge"] = str(loaded.knowledge_path.resolve())
    if scanner is not None:
        file = with_scanner(loaded, scanner).file
        table["cell"]["mode"] = file.cell.mode
        table["devices"][SCANNER] |= file.devices[SCANNER].model_dump(include={"driver", "options"})
        if scanner in WIRES:
            emulator = file.emulators[SCANNER].model_dump(exclude_none=True)
            table["emulators"] = table.get("emulators", {}) | {SCANNER: emulator}
    path = folder / "cell.toml"
    path.write_text(tomlkit.dumps(table), encoding="utf-8")
    return path


def by_kind(runs: Sequence[Run]) -> str:
    """A table of all runs' readings and actions by the kind of the object, as the judge has them."""
    counts: dict[str, Counter[str]] = {}
    for each in runs:
        kinds = {reading["name"]: reading["kind"] for reading in each.report["readings"]}
        for reading in each.report["readings"]:
            refused = reading["reason"] is not None or not reading["present"]
            counts.setdefault(reading["kind"], Counter())["read, refused"] += refused
        for claim in each.judge["claims"]:
            did = "worked" if "reached" in claim else "read"
            counts[kinds[claim["name"]]][f"{did}, {'right' if claim['right'] else 'wrong'}"] += 1
        for action in each.report["actions"]:
            counts[kinds[action["object"]]]["worked, not confirmed"] += not action["confirmed"]
    columns = [f"read, {how}" for how in ("right", "wrong", "refused")]
    columns += [f"worked, {how}" for how in ("right", "wrong", "not confirmed")]
    rows = [f"| {kind} | {' | '.join(str(n[column]) for column in columns)} |" for kind, n in sorted(counts.items())]
    return "\n".join([f"| kind | {' | '.join(columns)} |", f"|{' --- |' * (len(columns) + 1)}", *rows])


def built_places(cell: Cell, seed: int) -> dict[str, Array]:
    """Return where the simulator builds each object of the panel with this seed: (3,) on the plate, base frame."""
    draws = Draws(seed)
    base_from_panel = draws.panel_pose(cell.file.workspace, cell.file.simulation)
    return {
        built.panel_object.name: base_from_panel.apply([*np.add(built.panel_object.position_m, built.offset_m), 0.0])
        for built in build(cell.panel, draws)
    }


def summary(runs: Sequence[Run]) -> int:
    """Print the figures of all runs beside their pass lines; return 1 if one is missed."""
    n = len(runs)
    posed = [r.judge for r in runs if r.judge["pose_error_m"] is not None]
    done = sum(bool(r.report["succeeded"]) for r in runs)
    knocked = sum(bool(r.judge["moved_unasked"]) for r in runs)
    agreed = sum(bool(r.judge["agrees"]) for r in runs)
    inside = sum(bool(v["inside_95"]) for v in posed)
    right, given = (sum(r.judge[key] for r in runs) for key in ("readings_right", "readings_given"))
    error_mm = 1e3 * float(np.median([v["pose_error_m"] for v in posed]))
    error_deg = float(np.rad2deg(np.median([v["pose_error_rad"] for v in posed])))
    errors_m = [error for r in runs for error in r.by_surfaces_m.values()]
    found_mm = [1e3 * error for error in errors_m if error is not None]
    longest_s = max(r.report["cell_s"] for r in runs)
    lines = [
        (f"every action confirmed: {done} of {n}", done >= 0.95 * n),
        (f"the judge agrees: {agreed} of {n}", agreed == n),
        (f"missions that moved what nobody asked for: {knocked} of {n}", knocked == 0),
        (f"fused pose, median error: {error_mm:.2f} mm, {error_deg:.3f} deg", error_mm <= 2.0 and error_deg <= 0.3),
        (f"inside the stated 95 % ellipsoid: {inside} of {n}", inside >= 0.85 * n),
        (f"readings and states right: {right} of {given} ({100 * right / max(given, 1):.1f} %)", right >= 0.95 * given),
        (
            f"found by their surfaces: {len(found_mm)} of {len(errors_m)}, median error"
            f" {np.median(found_mm) if found_mm else np.nan:.2f} mm",
            len(found_mm) >= 0.9 * len(errors_m),
        ),
        (f"longest mission: {longest_s:.1f} s on the cell's clock", longest_s <= 60.0),
        (f"median mission: {np.median([r.report['wall_s'] for r in runs]):.1f} s on the wall", True),
    ]
    for text, is_met in lines:
        print(f"{'met   ' if is_met else 'MISSED'} {text}")
    return 0 if all(is_met for _, is_met in lines) else 1


def _pose(verdict: dict[str, Any]) -> tuple[str, str]:
    return f"{1e3 * verdict['pose_error_m']:.2f}", f"{np.rad2deg(verdict['pose_error_rad']):.3f}"


def _yes(value: bool | None) -> str:
    return "-" if value is None else ("yes" if value else "NO")


if __name__ == "__main__":
    raise SystemExit(main())
