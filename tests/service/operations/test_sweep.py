"""A line scanner swept by the wrist gives the same result as a range camera at the same pose."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hal.config import Cell, load_cell
from hal.devices import RangeScannerCapabilities
from hal.errors import DeviceError, StaleReading, Unsupported
from hal.simulated import Fault
from service.operations.acquisition import scan, sweep_rate_rad_per_s, sweep_scanner
from service.operations.find_panel import locate
from service.operations.locate import ScannedPlane, go_to_overview, plate_in
from service.operations.range_detection import Sighting, find_by_surfaces, surfaces_in
from service.operations.session import OperationContext, Session
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

ROOT = Path(__file__).parents[3]


def bench(seed: int, **options: Any) -> Cell:
    """Return the bench cell with further options of its range scanner."""
    cell = load_cell(ROOT / "cells/bench.toml", seed=seed)
    section = cell.file.devices["range_scanner"]
    devices = {
        **cell.file.devices,
        "range_scanner": section.model_copy(update={"options": {**section.options, **options}}),
    }
    return cell.model_copy(update={"file": cell.file.model_copy(update={"devices": devices})})


@contextmanager
def session_of(cell: Cell, folder: Path) -> Iterator[Session]:
    """Yield a session with its own task on an inline cell."""
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    try:
        yield Session(
            context=OperationContext(
                connection=LocalConnection(cell, runtime.objects, close=runtime.close),
                task=TaskContext(Task(id="test", verb="panel-pose", request={}, moves=True), folder / "artefacts"),
                runs_dir=folder / "runs",
                world=WorldModel(),
            )
        )
    finally:
        runtime.close()


def seen_from_the_overview(session: Session) -> tuple[ScannedPlane, list[Sighting]]:
    """Return the plate's plane, the mushroom and the wheel, measured from the overview."""
    go_to_overview(session)
    located = locate(session)
    image = scan(session)
    plane = plate_in(session, image)
    found = find_by_surfaces(surfaces_in(image), image, session.panel, located.base_from_panel, plane.fit.surface)
    return plane, found


def sigma_between(plane: ScannedPlane, session: Session) -> tuple[float, float]:
    """Return the sigma, m and rad, of a scanned plane, from the fit and the mount."""
    fit, mount = plane.fit.feature, session.mount("range_scanner").covariance
    offset = fit.direction @ fit.point_covariance @ fit.direction + fit.direction @ mount[:3, :3] @ fit.direction
    return float(np.sqrt(offset)), float(np.sqrt(np.trace(fit.direction_covariance) + mount[3, 3]))


@pytest.mark.slow
def test_a_swept_line_scanner_sees_the_plate_and_the_objects_that_a_range_camera_sees(tmp_path: Path) -> None:
    planes, found, sigmas = [], [], []
    for model in ("pinhole", "polar"):
        with session_of(bench(3, model=model), tmp_path / model) as session:
            plane, sightings = seen_from_the_overview(session)
            planes.append(plane)
            found.append({s.panel_object.name: s for s in sightings})
            truths = {true.name: true for true in session.connection.device("arm").truth().objects}
            sigmas.append(sigma_between(plane, session))
    image, swept = (plane.fit.feature for plane in planes)
    sigma_m, sigma_rad = np.linalg.norm(sigmas, axis=0)
    assert abs(image.direction @ (swept.point_m - image.point_m)) < 2.0 * sigma_m
    assert np.linalg.norm(np.cross(image.direction, swept.direction)) < 2.0 * sigma_rad
    assert set(found[0]) == set(found[1]) == {"bypass", "emergency"}
    for name in found[0]:
        assert found[1][name].match is not None and found[1][name].off_m < 0.004
    assert found[1]["emergency"].state == pytest.approx(found[0]["emergency"].state, abs=0.002)
    told, true = found[1]["bypass"].state, truths["bypass"].value
    assert told is not None and true is not None
    spoke_rad = 2.0 * np.pi / 3
    assert abs((told - true + spoke_rad / 2) % spoke_rad - spoke_rad / 2) < 0.2, "known modulo one spoke"


def test_the_arm_returns_from_a_sweep_and_a_frozen_or_lost_scanner_is_named(tmp_path: Path) -> None:
    with session_of(bench(3, model="polar", width=32, line_rate_hz=100.0), tmp_path) as session:
        stood = session.mover.state().position_rad
        swept = sweep_scanner(session, "range_scanner", session.connection.device("range_scanner"))
        assert np.abs(session.mover.state().position_rad - stood).max() < 2e-3
        assert (swept.capabilities.projection, swept.capabilities.needs_sweep) == ("pinhole", False)
        assert swept.depth_m.shape == (swept.capabilities.height, swept.capabilities.width)
        scanner = session.connection.device("range_scanner")
        scanner.inject_fault(Fault.FROZEN)
        with pytest.raises(StaleReading, match="range_scanner repeats the same line"):
            scan(session)
        scanner.inject_fault(Fault.DISCONNECTED)
        with pytest.raises(DeviceError, match="range_scanner"):
            scan(session)


def test_a_line_scanner_whose_driver_keeps_no_scans_is_refused_before_anything_moves() -> None:
    with pytest.raises(Unsupported, match="keeps no scans"):
        sweep_scanner(SimpleNamespace(), "lidar", SimpleNamespace())


@pytest.mark.parametrize(
    ("step_rad", "rate_hz", "lines"), [(np.pi / 180, 75.0, 96), (np.pi / 720, 40.0, 160), (np.pi / 360, 6.0, 110)]
)
def test_a_sweep_has_the_lines_that_the_beams_deserve(step_rad: float, rate_hz: float, lines: int) -> None:
    c = RangeScannerCapabilities(
        projection="polar",
        width=181,
        height=1,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
        min_range_m=0.0,
        max_range_m=8.0,
        sigma_m=0.01,
        rate_hz=rate_hz,
        step_angle_rad=step_rad,
    )
    assert 0.96 / sweep_rate_rad_per_s(c) * rate_hz == pytest.approx(lines, abs=1.0)
