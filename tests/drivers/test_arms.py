"""The last check of set-points before the drives."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from drivers.arms import KinematicsOptions, SetPointFilter, kinematics_of
from drivers.emulators.scripted import ScriptedArm
from hal.errors import InvalidRequest, MotionRefused

HERE = np.zeros(6)


def make_filter() -> SetPointFilter:
    options = KinematicsOptions.model_validate(kinematics_of(ScriptedArm().capabilities()), strict=False)
    return SetPointFilter("arm", options, command_rate_hz=100.0)


class Interrupting:
    """The arm's speeds; who multiplies them finds that the link is lost at that moment."""

    def __init__(self, speeds: Any, lose: threading.Thread) -> None:
        self._speeds, self._lose = speeds, lose

    def __mul__(self, other: float) -> Any:
        self._lose.start()
        self._lose.join(0.05)
        return self._speeds * other


def test_a_link_that_is_lost_while_a_set_point_passes_leaves_the_drives_off() -> None:
    filter_ = make_filter()
    filter_.begin(HERE)
    lose = threading.Thread(target=lambda: filter_.begin(None))
    filter_._velocity = Interrupting(filter_._velocity, lose)  # loses the link inside the check
    np.testing.assert_allclose(filter_.passed(HERE, 1.0), HERE)
    lose.join()
    assert not filter_.is_open
    with pytest.raises(MotionRefused, match="off"):
        filter_.passed(HERE, 1.01)


def test_a_leap_is_cut_to_what_the_joints_can_do_and_nonsense_is_refused() -> None:
    filter_ = make_filter()
    filter_.begin(HERE)
    sent = filter_.passed(np.full(6, 3.0), 1.0)
    assert np.all(sent > 0.0) and np.all(sent < 1.0)
    for wanted in (np.full(6, np.nan), np.zeros(5)):
        with pytest.raises(InvalidRequest, match="finite joint angles"):
            filter_.passed(wanted, 1.01)
