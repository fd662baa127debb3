"""Random values of a seed are repeatable, independent by name, and within the limits of the files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.calibration import CameraIntrinsics, MountRecord, ToolLoad
from hal.config import load_cell
from hal.geometry import difference, transform_rpy
from hal.panel import Button, Display, Gauge, Lamp, PanelMeter, Slider
from simbackend.bodies.display import display_text
from simbackend.draws import Draws
from simbackend.panel_state import build
from tests.simbackend.rig import BENCH

CELL = load_cell(BENCH)
SIGMA = (2e-4, 2e-4, 2e-4)
RECORD = MountRecord(
    position_m=(0.0, -0.09, 0.06), rpy_rad=(0.0, 0.0, 0.0), sigma_m=SIGMA, sigma_rad=(9e-4, 9e-4, 9e-4)
)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_the_panel_stays_within_the_cell_files_tolerance(seed: int) -> None:
    workspace, simulation = CELL.file.workspace, CELL.file.simulation
    expected = transform_rpy(workspace.panel_position_m, workspace.panel_rpy_rad)
    delta = difference(Draws(seed).panel_pose(workspace, simulation), expected)
    assert np.linalg.norm(delta[:3]) <= workspace.position_tolerance_m + 1e-9
    assert np.linalg.norm(delta[3:]) <= workspace.angle_tolerance_rad


def test_true_mounts_scatter_about_the_record_by_its_sigma() -> None:
    expected = RECORD.pose().parent_from_child
    errors = np.array([difference(Draws(seed).mount("camera", RECORD), expected) for seed in range(600)])
    np.testing.assert_allclose(errors.std(axis=0), [*SIGMA, 9e-4, 9e-4, 9e-4], rtol=0.12)
    np.testing.assert_allclose(errors.mean(axis=0) / errors.std(axis=0), 0.0, atol=0.17)


def test_streams_differ_by_name_and_seed_and_by_nothing_else() -> None:
    def first(seed: int, name: str) -> float:
        return float(Draws(seed).stream(name).uniform())

    assert first(1, "a") == first(1, "a")
    assert len({first(1, "a"), first(2, "a"), first(1, "b")}) == 3


def test_noise_is_a_function_of_the_tick_and_not_of_the_reader() -> None:
    noise = Draws(3).noise("ft", 6)
    forwards = [noise.at(tick).copy() for tick in (0, 511, 512, 5000)]
    again = Draws(3).noise("ft", 6)
    for tick, expected in zip((5000, 512, 511, 0), forwards[::-1], strict=True):
        np.testing.assert_array_equal(again.at(tick), expected)
    many = np.array([noise.at(tick) for tick in range(4000)])
    np.testing.assert_allclose(many.std(axis=0), 1.0, atol=0.05)
    assert abs(np.corrcoef(many[:-1, 0], many[1:, 0])[0, 1]) < 0.06


def test_the_lens_and_the_load_are_near_their_records_and_not_on_them() -> None:
    lens = CameraIntrinsics(width_px=640, height_px=480, fx_px=460.0, fy_px=460.0, cx_px=319.5, cy_px=239.5)
    true = Draws(8).lens("camera", lens)
    assert 0 < abs(true.fx_px - 460.0) < 460.0 * 0.0025
    assert true.fx_px / true.fy_px == 1.0
    load = Draws(8).load("ft", ToolLoad(mass_kg=0.9, centre_of_mass_m=(0.0, 0.0, 0.09), bias=(0.0,) * 6))
    assert 0 < abs(load.mass_kg - 0.9) < 0.1
    assert all(b != 0.0 for b in load.bias)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_what_a_seeded_panel_shows_is_within_its_scales(seed: int) -> None:
    built = {item.panel_object.name: item for item in build(CELL.panel, Draws(seed))}
    assert list(built) == [panel_object.name for panel_object in CELL.panel.objects]
    for item in built.values():
        panel_object = item.panel_object
        if isinstance(panel_object, (Gauge, PanelMeter, Slider)):
            assert item.start.value is not None
            assert panel_object.scale.minimum <= item.start.value <= panel_object.scale.maximum
            assert panel_object.scale.value_at(item.start.place) == pytest.approx(item.start.value)
        if isinstance(panel_object, Display):
            assert float(item.start.text or "nan") == pytest.approx(item.start.value)
        if isinstance(panel_object, Button) and not panel_object.latching:
            assert not item.start.is_on


def test_a_lamp_that_a_button_lights_begins_dark() -> None:
    lit = [
        panel_object.lights_lamp
        for panel_object in CELL.panel.objects
        if isinstance(panel_object, Button) and panel_object.lights_lamp
    ]
    assert lit
    for seed in range(20):
        for item in build(CELL.panel, Draws(seed)):
            if isinstance(item.panel_object, Lamp) and item.panel_object.name in lit:
                assert not item.start.is_on


def test_states_differ_from_seed_to_seed() -> None:
    shown = {tuple(round(item.start.place, 6) for item in build(CELL.panel, Draws(seed))) for seed in range(5)}
    assert len(shown) == 5


@pytest.mark.parametrize(("value", "text"), [(159.3, "159.3"), (7.0, "  7.0"), (0.04, "  0.0")])
def test_a_display_is_right_justified_and_the_point_takes_no_digit(value: float, text: str) -> None:
    panel_object = Display(name="d", position_m=(0.0, 0.0), width_m=0.08, height_m=0.03, digits=4, decimals=1)
    # Four digits and a point: five characters.
    assert display_text(panel_object, value) == text.rjust(5)
