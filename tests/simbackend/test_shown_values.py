"""Tests of instruments and lamps that show another value while the world runs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from hal.errors import InvalidRequest
from hal.simulated import ShowsValues
from tests.simbackend.rig import SimCell, sim_cell


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


def test_what_shows_no_value_of_a_process_is_refused(cell: SimCell) -> None:
    arm = cell.connect("arm")
    for name in ("main_valve", "no_such_object"):
        with pytest.raises(InvalidRequest, match="cannot be made to show a value"):
            arm.show(name, 1.0)
