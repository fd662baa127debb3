"""Tests of the UR arm: conformance over RTDE and script port, watchdog, protective stop, recipes, known packages."""

import struct
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators import ur as emulator
from drivers.emulators.scripted import ScriptedArm
from drivers.ur import rtde
from drivers.ur.arm import OUTPUTS
from drivers.ur.session import RtdeSession
from hal.conformance import ArmContract, Rig
from hal.errors import CellError, DeviceFault, MotionRefused
from tests.drivers.rigs import ScriptLink, count_good, soon, until, wired, wired_rig

DRIVER = "ur:rtde"
NO_LIMITS = {"away_s": 0.05, "delay_s": 0.05, "silent_s": 0.05}


class TestUr(ArmContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(
            emulator.start(ScriptedArm(), {}), DRIVER, {"rate_hz": 125.0, "watchdog_s": 0.2}, sample_period_s=0.1
        ) as rig:
            yield rig


def test_packages_are_the_guides() -> None:
    assert rtde.outputs_request(("actual_q", "actual_qd"), 500.0).hex() == (
        "001d4f407f40000000000061637475616c5f712c61637475616c5f7164"
    )
    recipe = rtde.recipe(1, ["speed_slider_mask"], ["UINT32"])
    assert recipe.pack([1]).hex() == "0008550100000001"
    assert rtde.split_names(b"DOUBLE,VECTOR6D,") == ("DOUBLE", "VECTOR6D")


@pytest.mark.parametrize("refusal", ["NOT_FOUND", "IN_USE"])
def test_refused_variables_are_named(refusal: str) -> None:
    with pytest.raises(rtde.RecipeRefused, match="actual_q"):
        rtde.recipe(1, ["timestamp", "actual_q"], ["DOUBLE", refusal])


@given(st.lists(st.integers(min_value=0), max_size=10), st.lists(st.binary(min_size=25, max_size=25), max_size=6))
def test_packages_do_not_depend_on_chunks(cuts: list[int], bodies: list[bytes]) -> None:
    data = b"".join(rtde.package("U", body) for body in bodies)
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    parser = rtde.PackageParser()
    parser.data_size = 28
    found = [p for a, b in pairwise(places) for p in parser.feed(data[a:b])]
    assert found == [("U", body) for body in bodies]


def test_lost_and_foreign_bytes_cost_the_packages_beside_them_and_no_more() -> None:
    bodies = [struct.pack(">25B", *([i] * 25)) for i in range(1, 6)]
    packages = [rtde.package("U", body) for body in bodies]
    parser = rtde.PackageParser()
    parser.data_size = 28
    found = parser.feed(packages[0] + packages[1][:-2] + packages[2] + b"\x00\x1c" + packages[3] + packages[4])
    # 2 was cut; 3 is followed by bytes that begin no package, so it cannot be distinguished from a cut one
    assert [body[0] for _, body in found] == [1, 4, 5]


@pytest.mark.parametrize("lost", [slice(20, 21), slice(40, 42), slice(104, 107), slice(-3, -1)])
def test_a_package_that_lost_bytes_is_no_sample_even_where_nothing_tells_what_follows(lost: slice) -> None:
    types = ["DOUBLE", "VECTOR6D", "VECTOR6D", "INT32", "INT32", "UINT32"]
    recipe = rtde.recipe(9, OUTPUTS, types)
    wires = [recipe.pack([i, *[1e-5 * i] * 6, *[0.0] * 6, 7, 1, 1]) for i in (1, 2, 3)]
    session = RtdeSession()
    answers = (
        rtde.package("V", b"\1"),
        rtde.package("O", b"\x09" + ",".join(types).encode()),
        rtde.package("S", b"\1"),
    )
    session.begin(ScriptLink(*answers), outputs=OUTPUTS, rate_hz=125.0)
    cut = bytearray(wires[1])
    del cut[lost]
    heard = wires[0] + bytes(cut) + wires[2]
    gone = len(wires[1]) - len(cut)
    first = 2 * len(wires[0])  # the announced length of a package, filled up with the head of the next one
    found = [v["timestamp"] for chunk in (heard[:first], heard[first:]) for v in session.take(chunk)]
    assert gone and found in ([1.0], [1.0, 3.0])


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "disconnect"])
def test_no_fault_of_the_net_gives_wrong_joints(fault: str) -> None:
    arm = ScriptedArm()
    options = {**NO_LIMITS, "fault": fault, "every": 20 if fault == "disconnect" else 4, "seed": 8}
    with wired(emulator.start(arm, options), DRIVER, {"rate_hz": 125.0}) as device:
        assert count_good(device, lambda state: np.array_equal(state.position_rad, arm.position_rad)) >= 5


def follow(device: Any, arm: ScriptedArm, goal: Any) -> None:
    """Stream a set-point until the arm has reached it."""

    def has_arrived() -> bool:
        device.command_position(goal, deadline=soon())
        return arm.commands > 0 and bool(np.allclose(arm.position_rad, goal, atol=1e-6))

    until(has_arrived)


def test_set_points_arrive_to_a_microradian() -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), DRIVER, {"watchdog_s": 1.0}) as device:
        device.enable(deadline=soon())
        goal = arm.position_rad + 0.01
        follow(device, arm, goal)
        np.testing.assert_allclose(arm.position_rad, goal, atol=5.1e-7)


def test_a_silent_host_stops_the_arm_by_the_programs_watchdog() -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        follow(device, arm, arm.position_rad)
        until(lambda: arm.stops == 1)
        until(lambda: device.read_state(deadline=soon()).value.is_enabled is False or not arm.is_enabled)
        with pytest.raises(MotionRefused, match="ended"):
            until(lambda: device.command_position(arm.position_rad, deadline=soon()) is None)


def test_enabling_alone_moves_nothing_and_waits_for_the_first_set_point() -> None:
    arm = ScriptedArm()
    before = arm.position_rad.copy()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        until(lambda: far_side.runtime == emulator.PLAYING)
        device.newest(soon(), not_before_s=soon(0.0).at_s + 0.2)
        assert arm.commands == 0
        np.testing.assert_array_equal(arm.position_rad, before)


def test_a_pause_after_the_set_point_that_follows_enabling_at_once_ends_the_program() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        device.command_position(arm.position_rad, deadline=soon())
        until(lambda: far_side.runtime == emulator.PLAYING)
        until(lambda: far_side.runtime == emulator.STOPPED)
        assert arm.stops == 1
        until(lambda: not device.read_state(deadline=soon()).value.is_enabled)
        with pytest.raises(MotionRefused, match="has ended"):
            device.command_position(arm.position_rad, deadline=soon())


def test_enabling_without_a_set_point_ends_the_program() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        until(lambda: far_side.runtime == emulator.PLAYING)
        until(lambda: far_side.runtime == emulator.STOPPED)
        assert (arm.commands, arm.stops) == (0, 1)
        until(lambda: not device.read_state(deadline=soon()).value.is_enabled)
        with pytest.raises(MotionRefused, match="has ended"):
            device.command_position(arm.position_rad, deadline=soon())


@pytest.mark.parametrize("old_beat", [-5, 0, 7, 2**31 - 1])
def test_the_set_point_that_an_older_session_left_in_the_registers_moves_nothing(old_beat: int) -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        until(lambda: device._is_marked and far_side._registers[32] != 0)
        far_side._registers[24:31] = [old_beat, *[500_000] * 6]
        device._beat = 10
        device._run_script(device._program(), soon())  # it starts before the first registers arrive
        until(lambda: far_side.runtime == emulator.PLAYING)
        device.newest(soon(), not_before_s=soon(0.1).at_s)
        assert arm.commands == 0


def test_a_protective_stop_ends_motion_and_a_person_must_see_to_it() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        far_side.protective_stop()
        with pytest.raises(DeviceFault, match="safety mode 3"):
            until(lambda: device.command_position(arm.position_rad, deadline=soon()) is None)
        with pytest.raises(DeviceFault, match="safety mode 3"):
            device.enable(deadline=soon())
        assert not arm.is_enabled


def test_after_a_lost_link_motion_stays_off() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        far_side.unplug(away_s=0.05)
        until(lambda: device.health().reconnects == 1)
        until(lambda: device.mailbox.error() is None)
        assert not device.read_state(deadline=soon()).value.is_enabled
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


def test_close_while_enabled_brakes() -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)
        device.close()
        until(lambda: not arm.is_enabled)


def test_a_jump_is_clipped_to_what_the_joints_can_do() -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        sent = device.command_position(arm.position_rad + 1.0, deadline=soon())
        assert np.all(sent - arm.position_rad < 0.2)


def test_a_variable_that_the_controller_lacks_stops_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(emulator.OUTPUT_TYPES, "actual_qd")
    far_side = emulator.start(ScriptedArm(), {})
    with pytest.raises(CellError, match="actual_qd"), wired(far_side, DRIVER):
        raise AssertionError("it connected")
    assert "actual_qd" in OUTPUTS
