"""The skills on the simulated bench with a panel pose wrong by 3 mm and 1 degree, judged by the simulator's truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.manipulation import SKILLS
from benchmarks.simcell import SimBench, open_bench
from hal.errors import DeviceFault, Stopped
from hal.motion import DeclaredMotion, MotionReport
from hal.simulated import Fault
from manipulation.skills.operate import operate
from manipulation.skills.outcome import Outcome
from manipulation.skills.probe import touch_probe
from manipulation.skills.retreat import park

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bench() -> Iterator[SimBench]:
    bench = open_bench(101)
    yield bench
    bench.close()


def test_a_touch_finds_the_true_plate_although_the_pose_is_wrong(bench: SimBench) -> None:
    point = touch_probe(bench.context, (0.0, 0.06, 0.0))
    true = bench.true_panel().inv().apply(point.point_m)
    believed = bench.context.panel_pose.inv().apply(point.point_m)
    assert abs(true[2]) < 0.001  # the gripper's mount has an uncertainty of 0.2 mm and 0.9 mrad
    assert abs(believed[2]) > abs(true[2])
    assert np.sqrt(point.normal @ point.covariance @ point.normal) < 0.001
    assert bench.peak_force_n() < 25.0


@pytest.mark.parametrize("skill", ["button", "toggle", "slider", "lever"])
def test_a_skill_does_what_it_says(bench: SimBench, skill: str) -> None:
    report, is_right, _ = SKILLS[skill](bench)
    assert (report.outcome is Outcome.DONE) == is_right, report.cause
    assert is_right, report.cause
    assert report.peak_force_n < 100.0
    park(bench.context)
    assert np.abs(bench.context.mover.state().position_rad - bench.context.park_rad).max() < 0.01


def test_a_skill_without_a_look_claims_nothing(bench: SimBench) -> None:
    goal = "off" if bench.truth("pump").state == "on" else "on"
    report = bench.operate("pump", goal)
    assert report.outcome is Outcome.UNVERIFIED
    assert bench.truth("pump").state == goal


def test_a_stop_in_the_middle_is_raised_and_the_arm_rests(bench: SimBench) -> None:
    bench.latched[0] = True
    with pytest.raises(Stopped):
        bench.operate("pump", "on")
    bench.latched[0] = False
    assert np.abs(bench.context.mover.state().velocity_rad_per_s).max() < 0.01


@pytest.mark.parametrize("device", ["wrist_ft", "finger_touch", "gripper"])
def test_a_sensor_that_dies_in_the_stroke_is_named_and_the_arm_parks_without_it(bench: SimBench, device: str) -> None:
    def die() -> None:
        bench.devices[device].inject_fault(Fault.SILENT)

    class Mover:
        """Lets the sensor die 0.2 s after the press has begun."""

        def __getattr__(self, name: str) -> Any:
            return getattr(bench.controller, name)

        def execute(self, motion: DeclaredMotion) -> MotionReport:
            if motion.name == "press":
                bench.shared.peek("world").at(bench.clock.now_s() + 0.2, die)
            return bench.controller.execute(motion)

    context = replace(bench.context, mover=Mover())
    with pytest.raises(DeviceFault) as caught:
        operate(context, context.panel.object("start"), "on")
    assert caught.value.details["device"] == device
    park(context)
    bench.devices[device].inject_fault(None)
    assert np.abs(bench.context.mover.state().position_rad - bench.context.park_rad).max() < 0.01
    assert bench.peak_force_n() < 100.0
