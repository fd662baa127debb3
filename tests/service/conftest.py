"""Fixtures of a cell of fake devices: real processes and sockets, but no physics."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2
import pytest

from hal.config import load_cell
from service.serve import Options, Panelwright
from tests.service.verbs import OPERATIONS

FAKES = Path(__file__).parent / "fakes"
PANEL = """
schema = 1
name = "fake"
width_m = 0.6
height_m = 0.4
lights = [
  { name = "a", position_m = [-0.28, 0.18, 0.0] },
  { name = "b", position_m = [0.28, 0.18, 0.0] },
  { name = "c", position_m = [0.28, -0.18, 0.0] },
  { name = "d", position_m = [-0.28, -0.18, 0.0] },
]
[[objects]]
kind = "lamp"
name = "pump_lamp"
position_m = [0.0, 0.0]
radius_m = 0.01
normal = ["on"]
what_to_do = "start the pump"
"""
MOUNT = """
schema = 1
device = "{name}"
date = "2026-11-20"
method = "drawing"
mount = {{ position_m = [0.0, 0.0, 0.05], rpy_rad = [0.0, 0.0, 0.0] }}
load = {{ mass_kg = 0.0, centre_of_mass_m = [0.0, 0.0, 0.0] }}
"""
SENSORS = {
    "wrist_camera": "camera",
    "range_scanner": "range_scanner",
    "finger_proximity": "proximity",
    "panel_lights": "lights",
}
ROBOT = {"arm": "arm", "gripper": "gripper", "finger_touch": "touch", "wrist_ft": "force_torque"}
MOUNTED = {"wrist_camera", "range_scanner", "finger_proximity", "wrist_ft"}

WriteCell = Callable[..., Path]


@pytest.fixture(autouse=True, scope="session")
def _fakes_are_installed() -> Iterator[None]:
    """Register the fakes as entry points, here and in child processes."""
    before = os.environ.get("PYTHONPATH")
    paths = [str(FAKES), str(Path(__file__).parents[2]), *([before] if before else [])]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    sys.path.insert(0, str(FAKES))
    yield
    sys.path.remove(str(FAKES))
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


@pytest.fixture
def write_cell(tmp_path: Path) -> WriteCell:
    """Return a function that writes a cell file of fakes, for example `write_cell(robot=True, mode="sim")`."""
    return lambda **given: _write(tmp_path, **given)


def _write(
    folder: Path,
    *,
    robot: bool = False,
    options: dict[str, dict[str, object]] | None = None,
    mode: str = "sim",
    extra: str = "",
) -> Path:
    (folder / "panel.toml").write_text(PANEL)
    (folder / "calibrations").mkdir(exist_ok=True)
    lines = [
        "schema = 1",
        f'[cell]\nname = "fake"\nmode = "{mode}"\npanel = "panel.toml"\ncalibrations = "calibrations"\nseed = 3',
        "[workspace]\npanel_position_m = [0.6, 0.0, 0.5]\npanel_rpy_rad = [0.0, -1.57, 0.0]",
        "park_rad = [0.0, -1.2, 1.6, 0.0, 0.8, 0.0]",
    ]
    for name, kind in {**SENSORS, **(ROBOT if robot else {})}.items():
        lines.append(f'[devices.{name}]\nkind = "{kind}"\ndriver = "fake:{kind}"')
        given = (options or {}).get(name, {})
        lines.append("options = { " + ", ".join(f"{k} = {_toml(v)}" for k, v in given.items()) + " }")
        if name in MOUNTED:
            lines.append(f'mount = {{ parent = "flange", calibration = "{name}" }}')
            (folder / "calibrations" / f"{name}.toml").write_text(MOUNT.format(name=name))
    path = folder / "cell.toml"
    path.write_text("\n".join([*lines, extra]))
    return path


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if not isinstance(value, str) else f'"{value}"'


@pytest.fixture(scope="module")
def write_module_cell(tmp_path_factory: pytest.TempPathFactory) -> WriteCell:
    """Return `write_cell` for fixtures that live as long as a test module."""
    folder = tmp_path_factory.mktemp("cell")
    return lambda **given: _write(folder, **given)


@pytest.fixture(scope="module")
def served(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    """Yield a complete panelwright, inline, on free ports: a cell of fakes, a robot and the verbs of `verbs.py`."""
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), inline=True)
    panelwright = Panelwright(load_cell(write_module_cell(robot=True)), options, operations=OPERATIONS)
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.fixture
def client(served: Panelwright) -> Iterator[httpx2.Client]:
    """Yield a client of `served`; everything works when a test begins."""
    with httpx2.Client(base_url=served.url, timeout=30.0, trust_env=False) as http:
        for task in http.get("/v1/tasks").json()["tasks"]:
            if task["state"] in ("queued", "running", "cancelling"):
                http.post(f"/v1/tasks/{task['id']}/cancel?wait_s=10")
        served.service.lease.take_over("cleaner")
        served.service.lease.release(served.service.lease.take_over("cleaner").token)
        for name in served.service.cell.file.devices:
            served.service.supervisor.connection.device(name).inject_fault(None)
        assert http.post("/v1/stop/reset", json={"seen_count": http.get("/v1/stop").json()["count"]}).status_code == 200
        yield http
