"""Contracts of arms, grippers and lights, the devices that move or switch something."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hal.conformance.device import DeviceContract, level
from hal.conformance.rig import Level, Rig
from hal.devices import Arm, DeviceKind, Gripper, Lights
from hal.errors import CellError, InvalidRequest, MotionRefused
from hal.readings import Stamped


class ArmContract(DeviceContract[Arm]):
    """Contract of an arm: joint state, streamed set-points, stop."""

    kind = DeviceKind.ARM

    def read(self, rig: Rig[Arm], duration_s: float = 2.0) -> Stamped[Any]:
        """Read the joint state."""
        return rig.device.read_state(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Arm], value: Any) -> None:
        """Check that the joint positions are finite and within their limits."""
        capabilities = rig.device.capabilities()
        assert value.position_rad.shape == value.velocity_rad_per_s.shape == (len(capabilities.links),)
        assert np.all(np.isfinite(value.position_rad)) and np.all(np.isfinite(value.velocity_rad_per_s))
        assert np.all(value.position_rad >= np.array(capabilities.lower_rad) - 1e-3)
        assert np.all(value.position_rad <= np.array(capabilities.upper_rad) + 1e-3)

    @level(Level.STATIC)
    def test_capabilities_agree_with_each_other(self, rig: Rig[Arm]) -> None:
        c = rig.device.capabilities()
        n = len(c.links)
        assert len(c.lower_rad) == len(c.upper_rad) == len(c.velocity_rad_per_s) == len(c.acceleration_rad_per_s2) == n
        assert all(low < high for low, high in zip(c.lower_rad, c.upper_rad, strict=True))
        assert c.command_rate_hz > 0

    @level(Level.MOTION)
    def test_the_measured_position_as_set_point_moves_nothing(self, rig: Rig[Arm]) -> None:
        rig.need_motion()
        before = self.read(rig).value.position_rad
        rig.device.enable(deadline=rig.deadline())
        rig.device.command_position(before, deadline=rig.deadline())
        rig.pass_time()
        np.testing.assert_allclose(self.read(rig).value.position_rad, before, atol=2e-3)

    @level(Level.MOTION)
    def test_a_small_step_is_followed(self, rig: Rig[Arm]) -> None:
        rig.need_motion()
        rig.device.enable(deadline=rig.deadline())
        start = self.read(rig).value.position_rad
        goal = start + _inward(rig.device, start) * 0.01
        self._stream(rig, start, goal)
        np.testing.assert_allclose(self.read(rig).value.position_rad, goal, atol=3e-3)

    @level(Level.MOTION)
    def test_what_is_sent_is_clipped_to_the_limits_and_told(self, rig: Rig[Arm]) -> None:
        rig.need_motion()
        rig.device.enable(deadline=rig.deadline())
        upper = np.array(rig.device.capabilities().upper_rad)
        sent = rig.device.command_position(upper + 1.0, deadline=rig.deadline())
        rig.device.stop(deadline=rig.deadline())
        assert np.all(sent <= upper + 1e-9)

    @level(Level.MOTION)
    def test_a_set_point_that_is_not_finite_is_refused(self, rig: Rig[Arm]) -> None:
        rig.need_motion()
        rig.device.enable(deadline=rig.deadline())
        wrong = np.full(len(rig.device.capabilities().links), math.nan)
        with pytest.raises((InvalidRequest, MotionRefused)):
            rig.device.command_position(wrong, deadline=rig.deadline())

    @level(Level.MOTION)
    def test_after_stop_commands_are_refused_until_enable(self, rig: Rig[Arm]) -> None:
        rig.need_motion()
        rig.device.enable(deadline=rig.deadline())
        rig.device.stop(deadline=rig.deadline())
        here = self.read(rig).value.position_rad
        with pytest.raises(CellError):
            rig.device.command_position(here, deadline=rig.deadline())
        rig.device.enable(deadline=rig.deadline())
        rig.device.command_position(self.read(rig).value.position_rad, deadline=rig.deadline())

    def _stream(self, rig: Rig[Arm], start: Any, goal: Any) -> None:
        period_s = 1.0 / rig.device.capabilities().command_rate_hz
        for fraction in (*np.linspace(0.0, 1.0, 100), *([1.0] * 100)):
            rig.device.command_position(start + fraction * (goal - start), deadline=rig.deadline())
            rig.clock.sleep(period_s)


class GripperContract(DeviceContract[Gripper]):
    """Contract of a gripper: width, grip, and commands that return the clipped value."""

    kind = DeviceKind.GRIPPER

    def read(self, rig: Rig[Gripper], duration_s: float = 2.0) -> Stamped[Any]:
        """Read width and grip."""
        return rig.device.read_state(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Gripper], value: Any) -> None:
        """Check that the width is within the range of the jaws."""
        c = rig.device.capabilities()
        assert c.min_width_m - 2e-3 <= value.width_m <= c.max_width_m + 2e-3
        assert math.isfinite(value.force_n)

    @level(Level.MOTION)
    def test_it_moves_to_a_width(self, rig: Rig[Gripper]) -> None:
        rig.need_motion()
        c = rig.device.capabilities()
        goal_m = 0.5 * (c.min_width_m + c.max_width_m)
        self._command(rig, goal_m)
        give_up = rig.deadline(5.0)
        while abs(self.read(rig).value.width_m - goal_m) > 2e-3 and not give_up.is_past():
            rig.pass_time()
        assert abs(self.read(rig).value.width_m - goal_m) <= 2e-3

    @level(Level.MOTION)
    def test_a_width_beyond_the_jaws_is_clipped_and_told(self, rig: Rig[Gripper]) -> None:
        rig.need_motion()
        c = rig.device.capabilities()
        assert self._command(rig, c.max_width_m + 1.0) <= c.max_width_m + 1e-9

    def _command(self, rig: Rig[Gripper], width_m: float) -> float:
        c = rig.device.capabilities()
        return rig.device.command(
            width_m=width_m,
            force_n=0.2 * c.max_force_n,
            speed_m_per_s=0.5 * c.max_speed_m_per_s,
            deadline=rig.deadline(),
        )


class LightsContract(DeviceContract[Lights]):
    """Contract of lights: they switch and report feedback."""

    kind = DeviceKind.LIGHTS

    def read(self, rig: Rig[Lights], duration_s: float = 2.0) -> Stamped[Any]:
        """Read the feedback of all channels."""
        return rig.device.read_on(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Lights], value: Any) -> None:
        """Check that there is one bool per channel."""
        assert len(value) == len(rig.device.capabilities().channels)
        assert all(isinstance(on, bool) for on in value)

    @level(Level.MOTION)
    @pytest.mark.parametrize("pattern", ["all", "none", "alternate"])
    def test_feedback_follows_the_command(self, rig: Rig[Lights], pattern: str) -> None:
        rig.need_motion()
        n = len(rig.device.capabilities().channels)
        wanted = {"all": (True,) * n, "none": (False,) * n, "alternate": tuple(i % 2 == 0 for i in range(n))}[pattern]
        assert rig.device.set_on(wanted, deadline=rig.deadline()) == wanted
        rig.clock.sleep(rig.device.capabilities().settle_s)
        rig.pass_time()
        assert self.read(rig).value == wanted

    @level(Level.MOTION)
    def test_the_wrong_number_of_channels_is_refused(self, rig: Rig[Lights]) -> None:
        rig.need_motion()
        n = len(rig.device.capabilities().channels)
        with pytest.raises(InvalidRequest):
            rig.device.set_on((True,) * (n + 1), deadline=rig.deadline())


def _inward(arm: Arm, here: Any) -> Any:
    """Return for each joint the direction (+1 or -1) away from its nearer limit."""
    c = arm.capabilities()
    return np.where(here > 0.5 * (np.array(c.lower_rad) + np.array(c.upper_rad)), -1.0, 1.0)
