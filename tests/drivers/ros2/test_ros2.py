"""Tests of the devices behind rosbridge: conformance, faults of the net, mapping of joints, controllers, stopping."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.emulators import ros2 as emulator
from drivers.emulators import ur
from drivers.emulators.ros2_nodes import CONTROLLER, POSITIONS_TOPIC, ArmNode
from drivers.emulators.scripted import ScriptedArm, ScriptedForceTorque, ScriptedGripper
from hal.clock import Deadline
from hal.conformance import ArmContract, ForceTorqueContract, GripperContract, Rig
from hal.devices import JointState
from hal.errors import DeviceFault, DeviceTimeout, DeviceUnavailable, MotionRefused
from hal.readings import Stamped
from hal.registry import Context, connect
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig

ARM, GRIPPER, FORCE_TORQUE = "ros2:arm", "ros2:gripper", "ros2:force_torque"
NO_LIMITS = {"away_s": 0.05, "delay_s": 0.05, "silent_s": 0.05}


class TestRos2Arm(ArmContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedArm(), {}), ARM, sample_period_s=0.1) as rig:
            yield rig


class TestRos2Gripper(GripperContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedGripper(), {}), GRIPPER, sample_period_s=0.1) as rig:
            yield rig


class TestRos2ForceTorque(ForceTorqueContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedForceTorque(), {}), FORCE_TORQUE, sample_period_s=0.1) as rig:
            yield rig


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "status", "disconnect"])
def test_no_fault_of_the_net_gives_wrong_joints(fault: str) -> None:
    arm = ScriptedArm()
    options = {**NO_LIMITS, "fault": fault, "every": 20 if fault == "disconnect" else 6, "seed": 8}
    with wired(emulator.start(arm, options), ARM) as device:
        assert count_good(device, lambda state: np.array_equal(state.position_rad, arm.position_rad)) >= 5


def follow(device: Any, arm: ScriptedArm, goal: Any) -> None:
    """Stream a set-point until the arm has reached it."""

    def has_arrived() -> bool:
        device.command_position(goal, deadline=soon())
        return arm.commands > 0 and bool(np.allclose(arm.position_rad, goal, atol=1e-9))

    until(has_arrived)


@pytest.mark.parametrize("options", [{}, {"command": "positions", "command_topic": POSITIONS_TOPIC}])
def test_joints_are_mapped_by_name_in_both_directions(options: dict[str, Any]) -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), ARM, options) as device:
        np.testing.assert_array_equal(device.read_state(deadline=soon()).value.position_rad, arm.position_rad)
        device.enable(deadline=soon())
        goal = arm.position_rad + np.array([0.01, 0.02, 0.03, -0.01, -0.02, -0.03])
        follow(device, arm, goal)


def test_an_arm_without_further_set_points_stops_at_the_last_one() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), ARM, {"horizon_s": 0.2}) as device:
        assert device.capabilities().watchdog_s == 0.2
        device.enable(deadline=soon())
        sent = device.command_position(arm.position_rad + 0.01, deadline=soon())
        until(lambda: far_side.node.trajectories == 2)
        far_side.unplug(away_s=0.1)  # the host is gone, the controller goes on
        until(lambda: bool(np.allclose(arm.position_rad, sent, atol=1e-9)))
        before = arm.commands
        until(lambda: arm.commands > before + 5)
        np.testing.assert_allclose(arm.position_rad, sent, atol=1e-9)


def test_after_a_lost_connection_motion_stays_off() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), ARM) as device:
        device.enable(deadline=soon())
        far_side.unplug(away_s=0.05)
        until(lambda: device.health().reconnects == 1)
        until(lambda: device.mailbox.error() is None)
        assert not device.read_state(deadline=soon()).value.is_enabled
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


def test_enabling_activates_the_controller_that_is_named() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {"is_active": False}), ARM, {"controller": CONTROLLER}) as device:
        assert not far_side.node.is_active
        device.enable(deadline=soon())
        assert far_side.node.is_active
        follow(device, arm, arm.position_rad + 0.01)


def test_a_controller_that_the_manager_does_not_know_refuses_the_motion() -> None:
    with (
        wired(emulator.start(ScriptedArm(), {"is_active": False}), ARM, {"controller": "other"}) as device,
        pytest.raises(MotionRefused, match="does not activate other"),
    ):
        device.enable(deadline=soon())


@pytest.mark.parametrize(("manager", "error"), [("/nowhere", DeviceFault)])
def test_a_controller_manager_that_is_not_there_is_named(manager: str, error: type[Exception]) -> None:
    options = {"controller": CONTROLLER, "controller_manager": manager}
    with (
        wired(emulator.start(ScriptedArm(), {}), ARM, options) as device,
        pytest.raises(error, match="/nowhere/switch_controller"),
    ):
        device.enable(deadline=soon())


def test_a_controller_manager_that_is_silent_is_a_timeout() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    far_side.node.serve = lambda service, args: far_side._closing.wait(0.4) or {"ok": True}
    with wired(far_side, ARM, {"controller": CONTROLLER, "max_age_s": 2.0}) as device, pytest.raises(DeviceTimeout):
        device.enable(deadline=soon(0.1))


def test_a_topic_of_another_type_is_a_fault_that_names_it() -> None:
    options = {"command_topic": POSITIONS_TOPIC}  # by trajectories
    with wired(emulator.start(ScriptedArm(), {}), ARM, options) as device:
        until(lambda: device._refusal != "")
        with pytest.raises(DeviceFault, match="already established with type std_msgs"):
            device.enable(deadline=soon())


class MovingArm(ScriptedArm):
    """Arm whose first joint reports 1 rad/s, whatever it is told."""

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        sample = super().read_state(deadline=deadline)
        velocity = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        return replace(sample, value=replace(sample.value, velocity_rad_per_s=velocity))


def test_a_stop_goes_to_where_the_arm_comes_to_rest_at_its_limit_and_refuses_further_set_points() -> None:
    arm = MovingArm()
    before = arm.position_rad.copy()
    with wired(far_side := emulator.start(arm, {}), ARM) as device:
        device.enable(deadline=soon())
        device.stop(deadline=soon())
        until(lambda: far_side.node.trajectories == 2)
        _, lasts_s, _, goal = far_side.node._path
        # at 10 rad/s^2 it takes 0.1 s and 0.05 rad
        assert lasts_s == pytest.approx(0.1)
        np.testing.assert_allclose(goal - before, [0.05, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


def test_close_while_enabled_stops() -> None:
    with wired(far_side := emulator.start(ScriptedArm(), {}), ARM) as device:
        device.enable(deadline=soon())
        until(lambda: far_side.node.trajectories == 1)
        device.close()
        until(lambda: far_side.node.trajectories == 2)


def test_a_second_arm_on_the_same_controller_is_refused_and_told_who_has_it() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    with wired(far_side, ARM), pytest.raises(DeviceUnavailable, match=r"is taken by process \d+, wired"):
        connect(Context(name="second"), ARM, dict(far_side.address))


def test_a_server_that_is_no_websocket_is_named() -> None:
    far_side = ur.start(ScriptedArm(), {})
    options = {**emulator_options(), "host": "127.0.0.1", "port": far_side.address["port"]}
    try:
        with pytest.raises(DeviceUnavailable, match="is no WebSocket server"):
            connect(Context(name="arm"), ARM, options)
    finally:
        far_side.close()


def emulator_options() -> dict[str, Any]:
    """Return joints and kinematics of a scripted arm as options."""
    return ArmNode(ScriptedArm(), is_active=True).options()


def test_a_grip_is_told_by_the_result_of_the_action() -> None:
    gripper = ScriptedGripper()
    gripper.object_m = 0.03
    with wired(emulator.start(gripper, {}), GRIPPER) as device:
        device.command(width_m=0.0, force_n=20.0, speed_m_per_s=0.15, deadline=soon())
        until(lambda: device.read_state(deadline=soon()).value.is_holding)
        state = device.read_state(deadline=soon()).value
        assert state.force_n == 20.0 and state.width_m == pytest.approx(0.03, abs=1e-6)
        device.command(width_m=0.08, force_n=20.0, speed_m_per_s=0.15, deadline=soon())
        until(lambda: not device.read_state(deadline=soon()).value.is_holding)
        until(lambda: abs(device.read_state(deadline=soon()).value.width_m - 0.08) < 1e-6)


def test_the_sign_of_a_wrench_is_an_option() -> None:
    far_side = emulator.start(ScriptedForceTorque(), {})
    with wired(far_side, FORCE_TORQUE) as one, wired(far_side, FORCE_TORQUE, {"sign": -1}) as other:
        assert np.all(one.read_wrench(deadline=soon()).value.force_n[:1] > 0.0)
        assert np.all(other.read_wrench(deadline=soon()).value.force_n[:1] < 0.0)
