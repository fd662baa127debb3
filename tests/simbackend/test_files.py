"""The shipped panel, cells and records are complete, can be simulated, and leave enough space for the fingers."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_cell
from hal.errors import ConfigError
from hal.panel import Gauge, Lever, load_panel
from hal.panel.kinds import installed_kinds
from tests.simbackend.rig import ROOT, SimCell, sim_cell

PANEL = load_panel(ROOT / "panels" / "bench.toml")
WORKED = {"button", "toggle", "rotary", "slider", "lever", "handwheel", "mushroom"}


READ_ONLY = {"gauge", "panel_meter", "display", "lamp"}


def test_the_bench_panel_has_instruments_and_controls_and_a_gauge_that_is_not_linear() -> None:
    assert {panel_object.kind for panel_object in PANEL.objects} == WORKED | READ_ONLY <= set(installed_kinds())
    gauges = [panel_object for panel_object in PANEL.objects if isinstance(panel_object, Gauge)]
    assert len(gauges) == 2
    assert sorted(bool(gauge.scale.table) for gauge in gauges) == [False, True]


def test_what_is_worked_stands_far_enough_apart_for_the_fingers() -> None:
    worked = [panel_object for panel_object in PANEL.objects if panel_object.kind in WORKED]
    for a, b in itertools.combinations(worked, 2):
        assert np.hypot(*np.subtract(a.position_m, b.position_m)) >= 0.07 + _reach(a) * 0.5, (a.name, b.name)


def _reach(panel_object: object) -> float:
    return panel_object.length_m if isinstance(panel_object, Lever) else 0.0


@pytest.mark.parametrize("name", ["bench", "ur10e"])
def test_a_cell_file_differs_from_the_bench_in_arm_and_workspace_only(name: str) -> None:
    bench = load_cell(ROOT / "cells" / "bench.toml").file.model_dump()
    other = load_cell(ROOT / "cells" / f"{name}.toml").file.model_dump()
    for parts in (bench, other):
        parts["devices"]["arm"]["options"] = parts["cell"]["name"] = parts["workspace"] = None
    assert other == bench


def test_the_nominal_tool_load_balances_the_model() -> None:
    """The record equals the load of the nominal tool: body, fingers and the sensor's lower part."""
    from simbackend import tool_model

    record = load_cell(ROOT / "cells" / "bench.toml").calibrations["wrist_ft"].load
    assert record is not None
    fingers = 2 * tool_model.FINGER_MASS_KG
    body = record.mass_kg - fingers - tool_model.SENSOR_MASS_KG
    moment = body * (0.21 - 0.13) + fingers * (0.21 - tool_model.FINGER_LENGTH_M / 2)
    assert record.centre_of_mass_m[2] == pytest.approx(moment / record.mass_kg, abs=2e-4)


@pytest.mark.parametrize(("name", "joints"), [("ur10e", 6), ("panda", 7)])
def test_a_cell_with_another_arm_comes_up_and_sees_its_panel(name: str, joints: int) -> None:
    with sim_cell(ROOT / "cells" / f"{name}.toml", seed=2) as cell:
        arm = cell.connect("arm")
        assert arm.capabilities().model == name
        assert arm.read_state(deadline=cell.deadline()).value.position_rad.shape == (joints,)
        arm.enable(deadline=cell.deadline())
        start = arm.read_state(deadline=cell.deadline()).value.position_rad
        cell.clock.sleep(0.5)
        assert np.abs(arm.read_state(deadline=cell.deadline()).value.position_rad - start).max() < 1e-5
        image = cell.connect("wrist_camera").read_image(deadline=cell.deadline()).value.pixels
        assert np.mean(image > 110) > 0.15  # the bright plate fills much of the image


# ruff: noqa: E501
ODD_PANEL = """
schema = 1
name = "odd"
width_m = 0.5
height_m = 0.4
lights = [
  { name = "a", position_m = [-0.2, 0.15, 0.0] },
  { name = "b", position_m = [0.2, 0.15, 0.02] },
  { name = "c", position_m = [0.2, -0.15, 0.0], radius_m = 0.004 },
  { name = "d", position_m = [-0.2, -0.15, 0.0] },
]
objects = [
  { kind = "gauge", name = "arm", position_m = [-0.15, 0.1], radius_m = 0.01, depth_m = 0.0, scale = { minimum = -1.0, maximum = 0.0, unit = "", at_min = 3.0, at_max = -3.0, major_ticks = 2 } },
  { kind = "panel_meter", name = "plate", position_m = [-0.05, 0.1], width_m = 0.03, height_m = 0.02, pivot_below_m = 0.0, needle_m = 0.01, depth_m = 0.0, scale = { minimum = 0.0, maximum = 1.0, unit = "V", at_min = -0.5, at_max = 0.5 } },
  { kind = "display", name = "floor", position_m = [0.05, 0.1], width_m = 0.03, height_m = 0.01, digits = 1, style = "lcd", minimum = -900.0, maximum = 900.0 },
  { kind = "lamp", name = "lamp", position_m = [0.1, 0.1], radius_m = 0.004, height_m = 0.0, colour = "white" },
  { kind = "button", name = "button", position_m = [-0.15, 0.0], radius_m = 0.005, preload_n = 0.0, latching = true, lights_lamp = "lamp" },
  { kind = "toggle", name = "toggle", position_m = [-0.1, 0.0], tilt_rad = 0.1 },
  { kind = "rotary", name = "rotary", position_m = [0.0, 0.0], radius_m = 0.01, states = [{ name = "x", angle_rad = -3.0 }, { name = "y", angle_rad = 3.0 }] },
  { kind = "slider", name = "slider", position_m = [0.1, 0.0], angle_rad = 1.57, travel_m = 0.02, scale = { minimum = 5.0, maximum = 6.0, unit = "", at_min = 0.01, at_max = -0.01 } },
  { kind = "lever", name = "lever", position_m = [-0.1, -0.1], length_m = 0.03, states = [{ name = "l", angle_rad = -1.0 }, { name = "m", angle_rad = 0.0 }, { name = "r", angle_rad = 1.0 }] },
  { kind = "handwheel", name = "wheel", position_m = [0.0, -0.1], spokes = 8, minimum_rad = 0.0, maximum_rad = 20.0 },
  { kind = "mushroom", name = "mushroom", position_m = [0.1, -0.1], preload_n = 0.0 },
]
"""


@pytest.mark.parametrize("text", [ODD_PANEL, ODD_PANEL[: ODD_PANEL.index("objects")]])
def test_a_panel_at_the_edges_of_the_file_format_is_built_and_seen(text: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.toml"
    path.write_text(text, encoding="utf-8")
    panel = load_panel(path)
    cell = SimCell(cell=load_cell(ROOT / "cells" / "bench.toml", seed=9).model_copy(update={"panel": panel}))
    try:
        truth = cell.connect("arm").truth()
        assert [panel_object.name for panel_object in truth.objects] == [
            panel_object.name for panel_object in panel.objects
        ]
        assert truth.objects == truth.initial
        cell.clock.sleep(0.2)
        after = {panel_object.name: panel_object.value for panel_object in cell.connect("arm").truth().objects}
        for panel_object in truth.initial:
            assert after[panel_object.name] == pytest.approx(panel_object.value, abs=2e-3), panel_object.name
        assert cell.connect("wrist_camera").read_image(deadline=cell.deadline()).value.pixels.std() > 10.0
    finally:
        cell.shared.close()


@pytest.mark.parametrize("park", [(0.0,) * 5, (9.0, 0.0, 0.0, 0.0, 0.0, 0.0)])
def test_a_parking_place_that_is_none_is_named(park: tuple[float, ...]) -> None:
    cell = load_cell(ROOT / "cells" / "bench.toml")
    workspace = cell.file.workspace.model_copy(update={"park_rad": park})
    wrong = cell.model_copy(update={"file": cell.file.model_copy(update={"workspace": workspace})})
    with pytest.raises(ConfigError) as caught:
        SimCell(cell=wrong).connect("arm")
    assert "workspace.park_rad" in str(caught.value)
