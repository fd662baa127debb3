"""Tests of instruments and lamps that show another value while the world runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.config import load_cell
from hal.errors import ConfigError, InvalidRequest
from hal.simulated import ShowsValues
from simbackend import world as world_module
from simbackend.wire import WorldConfig
from simbackend.world import PAST_TICKS, World
from tests.simbackend.rig import ROOT, SimCell, sim_cell


@pytest.fixture(scope="module")
def cell() -> Iterator[SimCell]:
    with sim_cell() as running:
        yield running


def truth_of(arm: Any, name: str) -> Any:
    return next(one for one in arm.truth().objects if one.name == name)


def test_needles_digits_and_lamps_show_what_they_are_told(cell: SimCell) -> None:
    arm = cell.connect("arm")
    assert isinstance(arm, ShowsValues)
    for name, value in (("pressure", 6.25), ("flow", 71.0), ("current", 1.5), ("temperature", 42.5), ("pressure", 3.0)):
        arm.show(name, value)
        cell.clock.sleep(0.02)
        assert truth_of(arm, name).value == pytest.approx(value, abs=1e-6)
    assert truth_of(arm, "temperature").text.strip() == "42.5"
    arm.show("run_lamp", 1.0)
    assert truth_of(arm, "run_lamp").state == "on"
    arm.show("run_lamp", 0.0)
    assert truth_of(arm, "run_lamp").state == "off"


@pytest.mark.parametrize(("name", "values"), [("temperature", (11.1, 88.8)), ("pressure", (1.0, 9.0))])
def test_the_picture_changes_with_the_value_and_back(cell: SimCell, name: str, values: tuple[float, float]) -> None:
    arm, camera = cell.connect("arm"), cell.connect("wrist_camera")

    def picture(value: float) -> Any:
        arm.show(name, value)
        cell.clock.sleep(0.02)
        return camera.read_image(deadline=cell.deadline(5.0)).value.pixels.astype(float)

    first, other, again = picture(values[0]), picture(values[1]), picture(values[0])
    assert np.abs(other - first).max() > 25.0
    assert np.abs(again - first).max() < 25.0  # noise only


def test_the_states_of_a_time_are_known_though_nothing_has_changed_since(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world_module, "PAST_KEPT", 2)
    bench = load_cell(ROOT / "cells/bench.toml", seed=11)
    world = World(WorldConfig(cell=bench, model="t3", proximity=(), proximity_range_m=0.3))
    number = next(i for i, one in enumerate(bench.panel.objects) if one.name == "pressure")

    def advance(steps: int) -> float:
        """Advance by so many steps at which states are kept; return the time."""
        for _ in range(PAST_TICKS * steps):
            world._advance()
        return world.tick * world.dt_s

    def pressure(time_s: float) -> float:
        return next(one.value for one in world.truth(time_s).initial if one.name == "pressure")

    try:
        built = pressure(0.0)
        world.show(number, 2.5)
        first_s = advance(1)
        later_s = advance(5)
        world.show(number, 7.5)
        last_s = advance(1)
        assert built not in (2.5, 7.5)
        assert [pressure(at_s) for at_s in (0.0, first_s, later_s, last_s)] == pytest.approx([built, 2.5, 2.5, 7.5])
    finally:
        world.close()


def test_what_shows_no_value_of_a_process_is_refused(cell: SimCell) -> None:
    arm = cell.connect("arm")
    for name in ("main_valve", "no_such_object"):
        with pytest.raises(InvalidRequest, match="cannot be made to show a value"):
            arm.show(name, 1.0)


def cell_that_shows(folder: Path, shows: str) -> Path:
    text = (ROOT / "cells/bench.toml").read_text(encoding="utf-8")
    for name in ("panels/", "cells/"):
        text = text.replace(f'"{name}', f'"{ROOT}/{name}')
    path = folder / "cell.toml"
    path.write_text(f"{text}\n[simulation]\nshows = {shows}\n", encoding="utf-8")
    return path


def test_a_cell_file_says_what_instruments_show_at_first(tmp_path: Path) -> None:
    path = cell_that_shows(tmp_path, "{ pressure = 4.25, run_lamp = 1, temperature = 55.5 }")
    running = SimCell(cell=load_cell(path))
    try:
        arm = running.connect("arm")
        assert [truth_of(arm, name).value for name in ("pressure", "temperature")] == [pytest.approx(4.25), 55.5]
        assert truth_of(arm, "run_lamp").state == "on"
    finally:
        running.shared.close()


def test_what_cannot_show_that_is_refused_by_its_key(tmp_path: Path) -> None:
    running = SimCell(cell=load_cell(cell_that_shows(tmp_path, "{ main_valve = 1, steam = 2 }")))
    with pytest.raises(ConfigError, match=r"simulation\.shows: main_valve, steam cannot be made"):
        running.connect("arm")
    text = cell_that_shows(tmp_path, "{ pressure = 1 }").read_text(encoding="utf-8")
    (tmp_path / "cell.toml").write_text(text.replace('mode = "sim"', 'mode = "real"'), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"simulation\.shows needs"):
        load_cell(tmp_path / "cell.toml")
