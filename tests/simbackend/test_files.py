"""The shipped panel, cells and records: whole, buildable and roomy enough for the fingers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hal.config import load_cell
from hal.panel import OBJECT_KINDS, Gauge, Lever, load_panel
from tests.simbackend.rig import ROOT, sim_cell

PANEL = load_panel(ROOT / "panels" / "bench.toml")
WORKED = {"button", "toggle", "rotary", "slider", "lever", "handwheel", "mushroom"}


def test_the_bench_panel_has_every_kind_and_a_gauge_that_is_not_linear() -> None:
    assert {thing.kind for thing in PANEL.objects} == set(OBJECT_KINDS)
    gauges = [thing for thing in PANEL.objects if isinstance(thing, Gauge)]
    assert len(gauges) == 2
    assert sorted(bool(gauge.scale.table) for gauge in gauges) == [False, True]


def test_what_is_worked_stands_far_enough_apart_for_the_fingers() -> None:
    worked = [thing for thing in PANEL.objects if thing.kind in WORKED]
    for a, b in itertools.combinations(worked, 2):
        assert np.hypot(*np.subtract(a.position_m, b.position_m)) >= 0.07 + _reach(a) * 0.5, (a.name, b.name)


def _reach(thing: object) -> float:
    return thing.length_m if isinstance(thing, Lever) else 0.0


@pytest.mark.parametrize("name", ["bench", "ur10e"])
def test_a_cell_file_differs_from_the_bench_in_arm_and_workspace_only(name: str) -> None:
    bench = load_cell(ROOT / "cells" / "bench.toml").file.model_dump()
    other = load_cell(ROOT / "cells" / f"{name}.toml").file.model_dump()
    for parts in (bench, other):
        parts["devices"]["arm"]["options"] = parts["cell"]["name"] = parts["workspace"] = None
    assert other == bench


def test_the_nominal_tool_load_balances_the_model() -> None:
    """The record is the weighing of the nominal tool: body, fingers and the sensor's lower part."""
    from simbackend import tool_model

    record = load_cell(ROOT / "cells" / "bench.toml").calibrations["wrist_ft"].load
    assert record is not None
    fingers = 2 * tool_model.FINGER_MASS_KG
    body = record.mass_kg - fingers - tool_model.SENSOR_MASS_KG
    moment = body * (0.21 - 0.13) + fingers * (0.21 - tool_model.FINGER_LENGTH_M / 2)
    assert record.centre_of_mass_m[2] == pytest.approx(moment / record.mass_kg, abs=2e-4)


def test_the_ur10e_cell_comes_up_and_sees_its_panel() -> None:
    with sim_cell(ROOT / "cells" / "ur10e.toml", seed=2) as cell:
        arm = cell.connect("arm")
        assert arm.capabilities().model == "ur10e"
        arm.enable(deadline=cell.deadline())
        start = arm.read_state(deadline=cell.deadline()).value.position_rad
        cell.clock.sleep(0.5)
        assert np.abs(arm.read_state(deadline=cell.deadline()).value.position_rad - start).max() < 1e-5
        image = cell.connect("wrist_camera").read_image(deadline=cell.deadline()).value.pixels
        assert np.mean(image > 110) > 0.15  # the light plate fills a good part of the view
