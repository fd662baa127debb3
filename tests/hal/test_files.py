"""Valid cell, panel and calibration files are read; errors in wrong ones name file, key and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import ConfigError, InvalidRequest, Retry
from hal.panel import Scale, load_panel

PANEL = """
schema = 1
name = "tiny"
width_m = 0.4
height_m = 0.3
lights = [
  { name = "nw", position_m = [-0.18, 0.13, 0.0] }, { name = "ne", position_m = [0.18, 0.13, 0.0] },
  { name = "se", position_m = [0.18, -0.13, 0.0] }, { name = "sw", position_m = [-0.18, -0.13, 0.0] },
]
[[objects]]
kind = "gauge"
name = "pressure"
position_m = [0.0, 0.0]
radius_m = 0.03
scale = { minimum = 0.0, maximum = 10.0, unit = "bar", at_min = -2.356, at_max = 2.356 }
"""
CELL = """
schema = 1
[cell]
name = "tiny"
mode = "sim"
panel = "panels/tiny.toml"
calibrations = "cells/calibrations"
seed = 7
[devices.arm]
kind = "arm"
driver = "sim:arm"
[devices.wrist_camera]
kind = "camera"
driver = "sim:camera"
mount = { parent = "flange", calibration = "wrist_camera" }
[workspace]
panel_position_m = [0.8, 0.0, 0.5]
panel_rpy_rad = [1.5708, 0.0, -1.5708]
park_rad = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
"""
CALIBRATION = """
schema = 1
device = "wrist_camera"
date = "2026-11-20"
method = "drawing"
[mount]
position_m = [0.0, 0.05, 0.02]
rpy_rad = [0.0, 0.0, 0.0]
sigma_m = [0.001, 0.001, 0.002]
"""


@pytest.fixture
def cell_path(tmp_path: Path) -> Path:
    for folder in ("panels", "cells/calibrations"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "panels/tiny.toml").write_text(PANEL)
    (tmp_path / "cells/calibrations/wrist_camera.toml").write_text(CALIBRATION)
    path = tmp_path / "cells/tiny.toml"
    path.write_text(CELL)
    return path


def edit(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def test_a_cell_file_is_read_with_all_it_points_to(cell_path: Path) -> None:
    cell = load_cell(cell_path, seed=11)
    assert cell.file.cell.seed == 11
    assert cell.panel.object("pressure").kind == "gauge"
    assert cell.names_of(DeviceKind.CAMERA) == ("wrist_camera",)
    record = cell.calibration_of("wrist_camera")
    assert record.mount is not None
    assert record.mount.pose().covariance[2, 2] == pytest.approx(4e-6)


@pytest.mark.parametrize(
    ("old", "new", "key", "hint"),
    [
        ('mode = "sim"', 'mode = "sin"', "cell.mode", "did you mean 'sim'?"),
        ("seed = 7", "sed = 7", "cell.sed", "did you mean 'seed'?"),
        ("seed = 7", 'seed = "7"', "cell.seed", "give a whole number"),
        ('driver = "sim:arm"', 'drver = "sim:arm"', "devices.arm", ""),
        ('kind = "arm"', 'kind = "leg"', "devices.arm.kind", ""),
        ("panel_position_m = [0.8, 0.0, 0.5]", "panel_position_mm = [800, 0, 500]", "workspace", ""),
        ("panel_position_m = [0.8, 0.0, 0.5]", "panel_position_m = [nan, 0.0, 0.5]", "workspace.panel_position_m", ""),
        ('panel = "panels/tiny.toml"', 'panel = "panels/tinny.toml"', "cell.panel", "relative"),
    ],
)
def test_a_wrong_key_or_value_is_named(cell_path: Path, old: str, new: str, key: str, hint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_cell(edit(cell_path, old, new))
    error = caught.value
    assert str(cell_path) in str(error)
    assert key in str(error) or any(key in fault for fault in error.details["faults"])
    assert hint in error.hint
    assert error.retry is Retry.AFTER_FIX


CABLE = "[[simulation.cables]]\npath_m = {}\n"


@pytest.mark.parametrize(
    ("path_m", "mode", "says"),
    [
        ("[[0, 0, 0.05]]", "sim", "at least 2"),
        ("[[0, 0, 0.05], [0, 0.1, 0.05], [0, 0.1, 0.05]]", "sim", "a point twice in a row"),
        ("[[0, 0, 0.05], [0, 0.1, 0.05]]", "real", "simulation.cables need cell.mode"),
    ],
)
def test_a_cable_that_cannot_hang_is_refused(cell_path: Path, path_m: str, mode: str, says: str) -> None:
    cell_path.write_text(CELL.replace('mode = "sim"', f'mode = "{mode}"') + CABLE.format(path_m))
    with pytest.raises(ConfigError, match=says):
        load_cell(cell_path)


def test_the_panel_as_built_has_the_parts_of_the_stated_one(cell_path: Path) -> None:
    built = cell_path.parents[1] / "panels/built.toml"
    cell_path.write_text(CELL + '[simulation]\nbuilt_panel = "panels/built.toml"\n')
    built.write_text(PANEL.replace("radius_m = 0.03", "radius_m = 0.04"))
    cell = load_cell(cell_path)
    assert cell.built_panel is not None
    assert (cell.built_panel.objects[0].half_footprint_m, cell.panel.objects[0].half_footprint_m) == (
        (0.04, 0.04),
        (0.03, 0.03),
    )
    built.write_text(PANEL.replace('name = "pressure"', 'name = "flow"'))
    with pytest.raises(ConfigError, match="other lights, tags or objects"):
        load_cell(cell_path)
    cell_path.write_text(cell_path.read_text().replace('mode = "sim"', 'mode = "real"'))
    with pytest.raises(ConfigError, match=r"built_panel needs cell\.mode"):
        load_cell(cell_path)


@pytest.mark.parametrize("lit", ["start", "pressure", "lamp_2"])
def test_a_button_lights_lamps_only(cell_path: Path, lit: str) -> None:
    """Otherwise the object would fail only in the simulator, far from the panel file."""
    panel = cell_path.parents[1] / "panels/tiny.toml"
    button = f'kind = "button"\nname = "start"\nposition_m = [0.1, 0.0]\nradius_m = 0.01\nlights_lamp = "{lit}"\n'
    panel.write_text(f"{PANEL}[[objects]]\n{button}")
    with pytest.raises(ConfigError, match=f"start lights '{lit}', which is not a lamp"):
        load_panel(panel)


GAUGE = 'kind = "gauge"\nradius_m = 0.03\nscale = {{ minimum = 0.0, maximum = 10.0, unit = "bar", {} }}'
LEVER_STATES = 'kind = "lever"\nstates = [{ name = "open" }, { name = "open", angle_rad = 1.57 }]'


@pytest.mark.parametrize(
    ("panel_object", "says"),
    [
        (GAUGE.format("at_min = -1.0, at_max = 1.0, table = [[-1.0, 3.0]]"), "must all rise, or all fall"),
        (GAUGE.format("at_min = -1.0, at_max = 1.0, table = [[0.0, 3.0], [0.5, 3.0]]"), "must all rise, or all fall"),
        (GAUGE.format("at_min = 1.0, at_max = -1.0, table = [[0.0, 12.0]]"), "must all rise, or all fall"),
        (LEVER_STATES, "two states have the same name"),
        ('kind = "handwheel"\nminimum_rad = 1.0\nmaximum_rad = 1.0', "maximum_rad must be greater"),
        ('kind = "display"\nwidth_m = 0.04\nheight_m = 0.02\ndigits = 4\nminimum = 9.0\nmaximum = 1.0', "greater than"),
    ],
)
def test_an_object_that_cannot_be_is_refused_and_not_found_out_when_it_is_read(
    cell_path: Path, panel_object: str, says: str
) -> None:
    panel = cell_path.parents[1] / "panels/tiny.toml"
    panel.write_text(f'{PANEL}[[objects]]\nname = "thing"\nposition_m = [0.1, 0.0]\n{panel_object}\n')
    with pytest.raises(ConfigError, match=says):
        load_panel(panel)


def test_a_missing_file_names_the_nearest_one(cell_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist") as caught:
        load_cell(cell_path.with_name("tyni.toml"))
    assert "tiny.toml" in caught.value.hint


def test_broken_toml_is_told_with_its_line(cell_path: Path) -> None:
    with pytest.raises(ConfigError, match="line 3"):
        load_cell(edit(cell_path, "[cell]", "[cell"))


def test_the_mark_that_editors_on_windows_write_does_no_harm(cell_path: Path) -> None:
    plain = load_cell(cell_path)
    cell_path.write_text(cell_path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert load_cell(cell_path).file == plain.file


def test_a_misspelt_key_deep_in_a_panel_is_named_without_union_tags(cell_path: Path) -> None:
    path = edit(cell_path.parent.parent / "panels/tiny.toml", "radius_m = 0.03", "radus_m = 0.03")
    with pytest.raises(ConfigError) as caught:
        load_panel(path)
    assert any("objects.0.radus_m" in fault for fault in caught.value.details["faults"])


def test_an_object_off_the_plate_is_refused(cell_path: Path) -> None:
    path = edit(cell_path.parent.parent / "panels/tiny.toml", "position_m = [0.0, 0.0]", "position_m = [0.3, 0.0]")
    with pytest.raises(ConfigError, match=r"pressure .* lies off the plate"):
        load_panel(path)


def test_an_unknown_object_names_the_nearest(cell_path: Path) -> None:
    with pytest.raises(InvalidRequest) as caught:
        load_cell(cell_path).panel.object("presure")
    assert "pressure" in caught.value.hint


def test_a_scale_with_a_table_goes_both_ways() -> None:
    scale = Scale(minimum=0.0, maximum=100.0, unit="%", at_min=-1.0, at_max=1.0, table=((0.0, 20.0),))
    assert scale.value_at(0.0) == pytest.approx(20.0)
    assert scale.value_at(0.5) == pytest.approx(60.0)
    for value in (-5.0, 0.0, 10.0, 20.0, 77.0, 100.0, 105.0):
        assert scale.value_at(scale.place_of(value)) == pytest.approx(value)


def test_a_scale_may_run_backwards() -> None:
    scale = Scale(minimum=0.0, maximum=10.0, unit="bar", at_min=1.0, at_max=-1.0)
    assert scale.value_at(1.0) == pytest.approx(0.0)
    assert scale.value_at(scale.place_of(7.0)) == pytest.approx(7.0)
