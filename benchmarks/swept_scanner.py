"""Compares the plate and the objects by a swept line scanner with those by a range camera, in the same cell and world.

    python -m benchmarks.swept_scanner FIRST LAST [--cells bench ur10e] [--ways polar scip lms200 rplidar]

Each seed is a bench: the range camera looks from the overview, then the cell is started again with a line scanner in its
place, simulated (`polar`) or by its real driver over an emulated wire. The offset is that of the swept plane at the
camera's point, along the camera's normal; the tilt is over the root of the mean of its two squared normalised parts. Sigmas
are the stated ones of both fits; the error of the mount that both scanners share is in neither. If the sigmas are right, the
squares of both have a mean of one; printed beside it is the share of runs that a chi-square puts below its 68th and 95th
percentile.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from hal.arrays import Array
from hal.config import Cell, EmulatorSection, load_cell
from hal.errors import CellError
from service.operations.acquisition import scan
from service.operations.find_panel import locate
from service.operations.locate import go_to_overview, plate_in
from service.operations.range_detection import find_by_surfaces, surfaces_in
from service.operations.session import OperationContext, Session
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

ROOT = Path(__file__).parents[1]
SCANNER = "range_scanner"
CAMERA = "camera"
WIRES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {  # driver, its options, its emulator's
    "scip": ("scip:scanner", {"sigma_m": 0.001}, {"scans_per_minute": 1500}),
    "lms200": ("serial:lms200", {"baud": 500_000, "step_hundredths_deg": 50, "sigma_m": 0.001}, {"scan_s": 0.0266}),
    "rplidar": (
        "serial:rplidar",
        {"scan_rate_hz": 10.0, "beams": 720, "sigma_m": 0.001},
        {"scan_rate_hz": 10.0, "nodes": 720, "bursts": 36, "is_rotating": True},
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """The plate's plane in the base frame, with its sigmas, and the names of the objects that a model matched."""

    point_m: Array
    normal: Array
    sigma_m: float
    normal_covariance: Array
    matched: frozenset[str]


def with_scanner(cell: Cell, way: str) -> Cell:
    """Return a simulated cell whose range scanner is of another kind: `polar`, or one of `WIRES`."""
    file = cell.file
    section = file.devices[SCANNER]
    emulators, mode = dict(file.emulators), file.cell.mode
    driver, options = section.driver, {**section.options, "model": "pinhole" if way == CAMERA else "polar"}
    if way in WIRES:
        behind = {**options, "width": 256}
        driver, options, far_options = WIRES[way]
        mode = "mixed"
        emulators[SCANNER] = EmulatorSection(
            emulator=way, driver=section.driver, options=behind, emulator_options=far_options
        )
    devices = {**file.devices, SCANNER: section.model_copy(update={"driver": driver, "options": options})}
    head = file.cell.model_copy(update={"mode": mode})
    return cell.model_copy(
        update={"file": file.model_copy(update={"devices": devices, "emulators": emulators, "cell": head})}
    )


@contextmanager
def session_of(cell: Cell, folder: Path) -> Iterator[Session]:
    """Yield a session with its own task on an inline cell."""
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    try:
        yield Session(
            context=OperationContext(
                connection=LocalConnection(cell, runtime.objects, close=runtime.close),
                task=TaskContext(Task(id="bench", verb="panel-pose", request={}, moves=True), folder / "artefacts"),
                runs_dir=folder / "runs",
                world=WorldModel(),
            )
        )
    finally:
        runtime.close()


def seen_from_the_overview(session: Session) -> Seen:
    """Drive to the overview, and measure plate and objects there."""
    go_to_overview(session)
    located = locate(session)
    image = scan(session)
    plane = plate_in(session, image)
    found = find_by_surfaces(surfaces_in(image), image, session.panel, located.base_from_panel, plane.fit.surface)
    feature, pose = plane.fit.feature, image.base_from_scanner.parent_from_child
    turn = pose.rotation.as_matrix()
    return Seen(
        point_m=pose.apply(feature.point_m),
        normal=pose.rotation.apply(feature.direction),
        sigma_m=feature.sigma_point_m,
        normal_covariance=turn @ feature.direction_covariance @ turn.T,
        matched=frozenset(s.panel_object.name for s in found if s.match is not None),
    )


def measure(name: str, way: str, seed: int) -> Seen:
    """Return what one scanner sees in one world."""
    cell = with_scanner(load_cell(ROOT / f"cells/{name}.toml", seed=seed), way)
    with tempfile.TemporaryDirectory() as folder, session_of(cell, Path(folder)) as session:
        return seen_from_the_overview(session)


def differences(camera: Seen, swept: Seen) -> tuple[float, float, float, float]:
    """Return offset, m, and angle, rad, between the planes of two scanners, and both in sigmas of the two fits."""
    offset_m = float(camera.normal @ (swept.point_m - camera.point_m))
    apart = swept.normal - camera.normal
    along = np.linalg.svd(camera.normal[np.newaxis])[2][1:]  # two axes in the plane
    tilt = along @ apart
    square = tilt @ np.linalg.solve(along @ (camera.normal_covariance + swept.normal_covariance) @ along.T, tilt)
    angle_rad = float(np.arcsin(np.clip(np.linalg.norm(np.cross(camera.normal, swept.normal)), 0.0, 1.0)))
    sigma_m = float(np.hypot(camera.sigma_m, swept.sigma_m))
    return offset_m, angle_rad, offset_m / sigma_m, float(np.sqrt(square / 2.0))


def summary(name: str, rows: list[tuple[float, float]]) -> str:
    """Return root mean square, extreme and shares within two percentiles of the normalised offsets and tilts."""
    offset, tilt = np.abs(np.array(rows)).T
    parts = []
    for label, values, degrees in (("offset", offset, 1), ("tilt", tilt, 2)):
        place = chi2.cdf(degrees * values**2, degrees)
        parts.append(
            f"{label} rms {np.sqrt(np.mean(values**2)):.2f} worst {values.max():.2f} sigma,"
            f" {np.mean(place < 0.68):.2f} and {np.mean(place < 0.95):.2f} within 68 and 95 %"
        )
    return f"{name}: {len(rows)} runs; " + "; ".join(parts)


def compare(name: str, way: str, seed: int, camera: Seen) -> tuple[float, float] | None:
    """Print one line for a sweep beside the camera, and return the normalised offset and tilt; None if it failed."""
    try:
        swept = measure(name, way, seed)
    except CellError as error:
        print(f"{name} {way} seed {seed}: {error.type_name}: {error}", flush=True)
        return None
    offset_m, angle_rad, offset, tilt = differences(camera, swept)
    sigma_deg = np.degrees(np.sqrt(np.trace(swept.normal_covariance) / 2.0))
    print(
        f"{name} {way} seed {seed}: {1e3 * offset_m:+.3f} mm ({offset:+.2f} sigma), {np.degrees(angle_rad):.3f} deg"
        f" ({tilt:.2f} sigma); sigmas {1e3 * swept.sigma_m:.3f} mm {sigma_deg:.3f} deg;"
        f" objects {len(swept.matched)} of {len(camera.matched)}",
        flush=True,
    )
    return offset, tilt


def main() -> None:
    """Print one line for each cell, way and seed, and how the normalised differences of each way are spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--cells", nargs="+", default=["bench", "ur10e"])
    parser.add_argument("--ways", nargs="+", default=["polar", *WIRES])
    arguments = parser.parse_args()
    table: dict[str, list[tuple[float, float]]] = {way: [] for way in arguments.ways}
    for name in arguments.cells:
        for seed in range(arguments.first, arguments.last + 1):
            camera = measure(name, CAMERA, seed)
            for way in arguments.ways:
                if (row := compare(name, way, seed, camera)) is not None:
                    table[way].append(row)
    for way, rows in table.items():
        if rows:
            print(summary(way, rows), flush=True)


if __name__ == "__main__":
    main()
