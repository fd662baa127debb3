"""Tests of readings, clocks, errors, frames and the registry."""

from __future__ import annotations

import pickle
import time

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from hal import errors
from hal.clock import Deadline, PacedClock, SimClock
from hal.errors import CellError, ConfigError, DeviceTimeout, InvalidRequest, Retry, StaleReading
from hal.frames import FrameTree
from hal.geometry import UncertainPose, certain, identity, transform_rpy
from hal.readings import Cause, Quality, Stamped
from hal.registry import Shared, device_factory


def test_an_old_reading_is_not_usable() -> None:
    reading = Stamped(value=1.0, host_time_s=10.0, sequence=1)
    assert reading.usable(now_s=10.05, max_age_s=0.1, device="tip") == 1.0
    with pytest.raises(StaleReading, match=r"tip reading is 0\.200 s old"):
        reading.usable(now_s=10.2, max_age_s=0.1, device="tip")


def test_an_invalid_reading_is_not_usable_however_fresh() -> None:
    reading = Stamped(value=1.0, host_time_s=10.0, sequence=1, quality=Quality.INVALID, cause=Cause.COMM)
    with pytest.raises(StaleReading, match="comm"):
        reading.usable(now_s=10.0, max_age_s=0.1, device="tip")


def test_a_sim_clock_steps_its_world() -> None:
    steps: list[float] = []
    clock = SimClock()
    clock.attach(lambda duration_s: steps.append(duration_s) or clock.now_s() + duration_s)
    clock.sleep(0.5)
    clock.sleep(-1.0)
    assert steps == [0.5]
    assert clock.now_s() == 0.5


def test_a_paced_clock_steps_its_world_and_waits_for_the_wall() -> None:
    steps: list[float] = []
    clock = PacedClock(lambda duration_s: steps.append(duration_s) or 0.0)
    before = clock.now_s()
    clock.sleep(0.002)
    assert steps == [0.002]
    assert clock.now_s() - before >= 0.002


def test_a_slow_world_makes_a_paced_clock_slow() -> None:
    def slow_world(_: float) -> float:
        end_s = time.monotonic() + 0.02
        while time.monotonic() < end_s:
            pass
        return 0.0

    clock = PacedClock(slow_world)
    before = clock.now_s()
    for _ in range(3):
        clock.sleep(0.002)
    assert clock.now_s() - before < 0.06


def test_a_paced_clock_that_nobody_ticks_goes_on() -> None:
    clock = PacedClock()
    deadline = Deadline.after(clock, 0.01)
    give_up_s = time.monotonic() + 5.0
    while not deadline.is_past():
        assert time.monotonic() < give_up_s


def test_a_paced_clock_tells_what_it_showed_at_a_moment_of_the_wall() -> None:
    clock = PacedClock()
    ticks: list[tuple[float, float]] = []
    for _ in range(3):
        clock.sleep(0.001)
        ticks.append((time.monotonic(), clock.now_s()))
    for wall_s, shown_s in ticks:
        assert clock.at_s(wall_s) == shown_s
    assert clock.at_s(ticks[0][0] - 10.0) < ticks[0][1] - 9.0  # before its stored ticks it follows the wall clock


def test_a_paced_clock_does_not_count_the_time_that_a_tick_took_too_long() -> None:
    walls: list[float] = []

    def slow_world(_: float) -> float:
        walls.append(time.monotonic())
        while time.monotonic() < walls[-1] + 0.05:
            pass
        return 0.0

    clock = PacedClock(slow_world)
    clock.sleep(0.002)
    clock.sleep(0.002)
    assert clock.now_s() - clock.at_s(walls[1]) == pytest.approx(0.002)


def test_a_deadline_counts_on_its_own_clock() -> None:
    clock = SimClock()
    deadline = Deadline.after(clock, 1.0)
    clock.sleep(0.75)
    assert deadline.remaining_s() == pytest.approx(0.25)
    clock.sleep(1.0)
    assert deadline.is_past()
    assert deadline.remaining_s() == 0.0


@pytest.mark.parametrize("kind", [e for e in vars(errors).values() if isinstance(e, type) and issubclass(e, CellError)])
def test_every_error_crosses_a_process_border_whole(kind: type[CellError]) -> None:
    error = kind("valve stuck", hint="oil it", device="arm")
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    assert type(copy) is kind
    assert (copy.what, copy.hint, copy.details, copy.retry) == ("valve stuck", "oil it", {"device": "arm"}, error.retry)


def test_an_error_reads_well_at_3_a_m() -> None:
    text = DeviceTimeout(
        "wrist_ft silent for 0.50 s", hint="check power and cable", link="serial /dev/ttyUSB1"
    ).for_people()
    assert text == (
        "DeviceTimeout: wrist_ft silent for 0.50 s\n"
        "  link   serial /dev/ttyUSB1\n"
        "  try    check power and cable\n"
        "  retry  safe"
    )
    faults = ["panel: is missing", "seed: is missing"]
    told = ConfigError("a.toml: panel: is missing (and 1 more fault)", hint="add panel", faults=faults).for_people()
    assert told.splitlines()[1:] == ["  also   seed: is missing", "  try    add panel", "  retry  after-fix"]
    assert DeviceTimeout("x", hint="y").type_name == "device-timeout"
    assert DeviceTimeout.retry is Retry.SAFE


def test_frames_chain_with_covariance() -> None:
    tree = FrameTree(links={"flange": ("base", certain(transform_rpy([1.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2])))})
    tip = UncertainPose(parent_from_child=transform_rpy([0.5, 0.0, 0.0], [0.0, 0.0, 0.0]), covariance=np.eye(6) * 1e-6)
    tree = tree.with_frame("tip", "flange", tip)
    np.testing.assert_allclose(tree.base_from("tip").parent_from_child.translation, [1.0, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(tree.base_from("tip").covariance, np.eye(6) * 1e-6, atol=1e-18)
    back = tree.pose("tip", "base").parent_from_child * tree.base_from("tip").parent_from_child
    np.testing.assert_allclose(back.as_matrix(), RigidTransform.identity().as_matrix(), atol=1e-12)


def test_a_frame_cannot_hang_on_itself_or_on_nothing() -> None:
    tree = FrameTree(links={"flange": ("base", certain(identity()))}).with_frame("tip", "flange", certain(identity()))
    with pytest.raises(InvalidRequest, match="cannot be its own ancestor"):
        tree.with_frame("flange", "tip", certain(identity()))
    with pytest.raises(InvalidRequest, match="no frame called 'nose'"):
        tree.base_from("nose")


def test_an_unknown_driver_names_the_nearest() -> None:
    with pytest.raises(ConfigError) as caught:
        device_factory("sim:amr")
    assert "sim:arm" in caught.value.hint


def test_shared_things_are_made_once_and_closed_in_reverse() -> None:
    closed: list[str] = []

    class Bus:
        def __init__(self, name: str) -> None:
            self.name = name

        def close(self) -> None:
            closed.append(self.name)

    shared = Shared()
    assert shared.get("a", lambda: Bus("a")) is shared.get("a", lambda: Bus("other"))
    shared.get("b", lambda: Bus("b"))
    shared.close()
    shared.close()
    assert closed == ["b", "a"]


def test_what_a_cell_shares_is_closed_whole_and_in_reverse_even_if_something_fails() -> None:
    closed: list[str] = []

    class Thing:
        def __init__(self, name: str) -> None:
            self.name = name

        def close(self) -> None:
            closed.append(self.name)
            if self.name == "second":
                raise OSError("a port that refuses even to close")

    shared = Shared()
    for name in ("first", "second", "third"):
        assert shared.get(name, lambda name=name: Thing(name)) is shared.peek(name)
    with pytest.raises(OSError, match="refuses"):
        shared.close()
    assert closed == ["third", "second", "first"]
    shared.close()


@pytest.mark.parametrize("kind", [SimClock, PacedClock])
def test_no_time_is_no_step_of_the_world(kind: type[SimClock] | type[PacedClock]) -> None:
    steps: list[float] = []

    def advance(duration_s: float) -> float:
        steps.append(duration_s)
        return 7.0

    clock = kind(advance)
    for duration_s in (0.0, -1.0):
        clock.sleep(duration_s)
    assert steps == []
