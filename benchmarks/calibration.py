"""Compares `panelwright calibrate` in the simulator with the truth of the seed: `python -m benchmarks.calibration`.

Every seed is a cell whose sensors differ slightly from their calibration records. After the new record has been
written, it is compared with the simulator's true values.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from hal.calibration import CalibrationRecord, load_calibration
from hal.config import Cell, load_cell
from hal.geometry import difference
from service.client import Client
from service.serve import Options, Panelwright
from simbackend.draws import Draws

WHAT = ("hand-eye", "camera", "scanner", "tool")
DEVICES = {"hand-eye": "wrist_camera", "camera": "wrist_camera", "scanner": "range_scanner", "tool": "wrist_ft"}
BENCH = Path(__file__).parents[1] / "cells" / "bench.toml"


def main() -> None:
    """Print one line per calibration and seed, and the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    parser.add_argument("--what", nargs="+", choices=WHAT, default=list(WHAT))
    parser.add_argument("--poses", type=int, default=12)
    given = parser.parse_args()
    errors: dict[str, list[tuple[float, float]]] = {}
    print("what      seed  before               after                sigma                scatter  wall s")
    for seed in given.seeds:
        with tempfile.TemporaryDirectory() as folder:
            _one_cell(seed, Path(folder), given.what, given.poses, errors)
    print()
    for what, found in errors.items():
        a, b = (float(np.median([pair[k] for pair in found])) for k in (0, 1))
        worst = [max(pair[k] for pair in found) for k in (0, 1)]
        words = _mass_words if what == "tool" else _mount_words
        goal = "   (pass: 1 mm, 0.2 deg)" if what == "hand-eye" else ""
        print(f"{what:9} median {words(a, b)}   worst {words(*worst)}{goal}")


def _one_cell(
    seed: int, runs: Path, whats: list[str], poses: int, errors: dict[str, list[tuple[float, float]]]
) -> None:
    cell = load_cell(BENCH, seed=seed)
    panelwright = Panelwright(load_cell(BENCH, seed=seed), Options(port=0, runs_dir=runs, inline=True))
    try:
        panelwright.start()
        client = Client(url=panelwright.url)
        for what in whats:
            begun_s = time.monotonic()
            task = client.post("/v1/calibrations", {"what": what, "poses": poses})
            while task["state"] not in ("succeeded", "failed", "cancelled"):
                task = client.get(f"/v1/tasks/{task['id']}?wait_s=20")
            took_s = time.monotonic() - begun_s
            if task["state"] != "succeeded":
                print(f"{what:9} {seed:4}  {task['state']}: {task['problem']['detail']}  {took_s:.0f} s")
                continue
            record = load_calibration(Path(task["result"]["path"]))
            before, after, sigma = _compared(cell, DEVICES[what], record, is_load=what == "tool")
            errors.setdefault(what, []).append(after)
            words = _mass_words if what == "tool" else _mount_words
            scatter = record.quality.get("chi_square_ratio", float("nan"))
            print(
                f"{what:9} {seed:4}  {words(*before):20} {words(*after):20} {words(*sigma):20} {scatter:5.2f}  {took_s:7.1f}"
            )
    finally:
        panelwright.close()


def _compared(
    cell: Cell, device: str, record: CalibrationRecord, *, is_load: bool
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Return (error before, error after, stated sigma), each as m and rad of a mount or as kg and N of a load."""
    draws, built = Draws(cell.file.cell.seed), cell.calibration_of(device)
    if is_load:
        assert record.load is not None and built.load is not None
        truth = draws.load(device, built.load.load())
        found, old = record.load.load(), built.load.load()
        bias = [float(np.linalg.norm(np.subtract(load.bias, truth.bias)[:3])) for load in (old, found)]
        return (
            (abs(old.mass_kg - truth.mass_kg), bias[0]),
            (abs(found.mass_kg - truth.mass_kg), bias[1]),
            (record.quality["mass_sigma_kg"], record.quality["rms_n"]),
        )
    assert record.mount is not None and built.mount is not None
    true = draws.mount(device, built.mount)
    pairs = []
    for mount in (built.mount, record.mount):
        e = difference(true, mount.pose().parent_from_child)
        pairs.append((float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:]))))
    sigma = (float(np.linalg.norm(record.mount.sigma_m)), float(np.linalg.norm(record.mount.sigma_rad)))
    return pairs[0], pairs[1], sigma


def _mount_words(m: float, rad: float) -> str:
    return f"{1e3 * m:.2f} mm {np.degrees(rad):.3f} deg"


def _mass_words(kg: float, n: float) -> str:
    return f"{1e3 * kg:.1f} g {n:.3f} N"


if __name__ == "__main__":
    main()
