"""One contract a device kind; see the package docstring."""

from __future__ import annotations

import inspect
import math
import statistics
from collections.abc import Iterator
from typing import Any, Generic, TypeVar

import numpy as np
import pytest

from hal.conformance.rig import SILENT_READS, SLACK_S, Level, Rig
from hal.devices import (
    PROTOCOLS,
    Arm,
    Camera,
    Device,
    DeviceKind,
    Fault,
    ForceTorque,
    Gripper,
    Lights,
    Proximity,
    RangeScanner,
    Touch,
)
from hal.errors import CellError, DeviceTimeout, DeviceUnavailable, InvalidRequest, MotionRefused
from hal.readings import Quality, Stamped

D = TypeVar("D", bound=Device)
level = pytest.mark.conformance


class DeviceContract(Generic[D]):
    """Promises that all kinds share; a kind says how to read its newest sample."""

    kind: DeviceKind

    @pytest.fixture
    def rig(self) -> Iterator[Rig[D]]:
        """The backend's device; every subclass supplies its own."""
        raise NotImplementedError("a conformance class needs a `rig` fixture")

    def read(self, rig: Rig[D], duration_s: float = 2.0) -> Stamped[Any]:
        """One read of the kind's main quantity."""
        raise NotImplementedError

    def check_value(self, rig: Rig[D], value: Any) -> None:
        """Is a value of the right type, shape and range?"""
        raise NotImplementedError

    @level(Level.STATIC)
    def test_it_says_its_name_and_kind(self, rig: Rig[D]) -> None:
        assert rig.device.name
        assert rig.device.kind is self.kind

    @level(Level.STATIC)
    def test_it_has_every_method_of_its_kind(self, rig: Rig[D]) -> None:
        assert isinstance(rig.device, PROTOCOLS[self.kind])

    @level(Level.STATIC)
    def test_every_call_to_the_device_takes_a_deadline(self, rig: Rig[D]) -> None:
        for name in _device_calls(self.kind):
            parameters = inspect.signature(getattr(type(rig.device), name)).parameters
            assert "deadline" in parameters, f"{name} has no deadline"
            assert parameters["deadline"].default is inspect.Parameter.empty, f"{name} has a default deadline"

    @level(Level.CONNECT)
    def test_health_says_connected_after_a_sample(self, rig: Rig[D]) -> None:
        self.read(rig)
        health = rig.device.health()
        assert health.connected
        assert health.samples >= 1

    @level(Level.CONNECT)
    def test_close_twice_is_once(self, rig: Rig[D]) -> None:
        rig.device.close()
        rig.device.close()
        assert not rig.device.health().connected

    @level(Level.CONNECT)
    def test_after_close_every_read_says_unavailable(self, rig: Rig[D]) -> None:
        rig.device.close()
        with pytest.raises(DeviceUnavailable) as caught:
            self.read(rig)
        assert rig.device.name in str(caught.value)

    @level(Level.READ)
    def test_a_sample_is_whole_and_stamped_in_the_past(self, rig: Rig[D]) -> None:
        sample = self.read(rig)
        assert sample.host_time_s <= rig.clock.now_s()
        if sample.quality is not Quality.INVALID:
            self.check_value(rig, sample.value)

    @level(Level.READ)
    def test_later_samples_have_later_stamps_and_numbers(self, rig: Rig[D]) -> None:
        first = self.read(rig)
        rig.pass_time()
        second = self.read(rig)
        assert second.sequence > first.sequence
        assert second.host_time_s > first.host_time_s

    @level(Level.READ)
    def test_a_disconnected_device_says_so_and_comes_back(self, rig: Rig[D]) -> None:
        self.read(rig)
        rig.begin(Fault.DISCONNECTED)
        rig.pass_time()
        with pytest.raises((DeviceUnavailable, DeviceTimeout)) as caught:
            self.read(rig, 0.2)
        assert rig.device.name in str(caught.value)
        rig.end_faults()
        self.read_until_it_works(rig)

    @level(Level.READ)
    def test_silence_is_a_timeout_and_in_time(self, rig: Rig[D]) -> None:
        self.read(rig)
        rig.begin(Fault.SILENT)
        rig.pass_time()
        over_s = []
        for _ in range(SILENT_READS):
            started_s = rig.clock.now_s()
            with pytest.raises(DeviceTimeout):
                self.read(rig, 0.1)
            over_s.append(rig.clock.now_s() - started_s - 0.1)
        assert statistics.median(over_s) <= SLACK_S
        rig.end_faults()
        self.read_until_it_works(rig)

    def read_until_it_works(self, rig: Rig[D]) -> None:
        """Read again and again, at most 5 s on the rig's clock."""
        give_up = rig.deadline(5.0)
        while True:
            try:
                self.read(rig, 0.5)
                return
            except (DeviceTimeout, DeviceUnavailable):
                if give_up.is_past():
                    raise
                rig.pass_time()


class ArmContract(DeviceContract[Arm]):
    """Joint state, streamed set-points, stop."""

    kind = DeviceKind.ARM

    def read(self, rig: Rig[Arm], duration_s: float = 2.0) -> Stamped[Any]:
        """Joint state."""
        return rig.device.read_state(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Arm], value: Any) -> None:
        """Finite joints within their limits."""
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
    """Width, grip, and commands that are told when clipped."""

    kind = DeviceKind.GRIPPER

    def read(self, rig: Rig[Gripper], duration_s: float = 2.0) -> Stamped[Any]:
        """Width and grip."""
        return rig.device.read_state(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Gripper], value: Any) -> None:
        """Width within the jaws' range."""
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


class CameraContract(DeviceContract[Camera]):
    """Frames of the promised size that began after the call."""

    kind = DeviceKind.CAMERA

    def read(self, rig: Rig[Camera], duration_s: float = 2.0) -> Stamped[Any]:
        """A frame."""
        return rig.device.read_image(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Camera], value: Any) -> None:
        """Size, depth and colour as promised."""
        c = rig.device.capabilities()
        shape = (c.height_px, c.width_px, 3) if c.is_colour else (c.height_px, c.width_px)
        assert value.pixels.shape == shape
        assert value.pixels.dtype == np.uint8

    @level(Level.STATIC)
    def test_the_nominal_lens_fits_the_image(self, rig: Rig[Camera]) -> None:
        c = rig.device.capabilities()
        assert (c.nominal.width_px, c.nominal.height_px) == (c.width_px, c.height_px)
        assert c.nominal.fx_px > 0 and c.nominal.fy_px > 0


class RangeScannerContract(DeviceContract[RangeScanner]):
    """Range images in metres with NaN where nothing was seen."""

    kind = DeviceKind.RANGE_SCANNER

    def read(self, rig: Rig[RangeScanner], duration_s: float = 2.0) -> Stamped[Any]:
        """A range image."""
        return rig.device.read_range(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[RangeScanner], value: Any) -> None:
        """Shape as promised; ranges within the sensor's limits or NaN."""
        c = rig.device.capabilities()
        assert value.depth_m.shape == (c.height, c.width)
        assert value.depth_m.dtype == np.float32
        seen = value.depth_m[np.isfinite(value.depth_m)]
        assert not np.any(np.isinf(value.depth_m))
        assert np.all((seen >= 0.5 * c.min_range_m) & (seen <= 1.1 * c.max_range_m))


class ProximityContract(DeviceContract[Proximity]):
    """A distance, or an invalid reading when nothing is near."""

    kind = DeviceKind.PROXIMITY

    def read(self, rig: Rig[Proximity], duration_s: float = 2.0) -> Stamped[Any]:
        """A distance."""
        return rig.device.read_distance_m(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Proximity], value: Any) -> None:
        """Within the measuring range."""
        c = rig.device.capabilities()
        assert isinstance(value, float)
        assert c.min_range_m - 5 * c.sigma_m <= value <= c.max_range_m + 5 * c.sigma_m

    @level(Level.READ)
    def test_nothing_in_range_is_invalid_and_not_a_number(self, rig: Rig[Proximity]) -> None:
        sample = self.read(rig)
        assert math.isfinite(sample.value) or sample.quality is Quality.INVALID


class TouchContract(DeviceContract[Touch]):
    """One switch a channel."""

    kind = DeviceKind.TOUCH

    def read(self, rig: Rig[Touch], duration_s: float = 2.0) -> Stamped[Any]:
        """All switches."""
        return rig.device.read_contacts(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Touch], value: Any) -> None:
        """A bool a channel."""
        assert len(value) == len(rig.device.capabilities().channels)
        assert all(isinstance(contact, bool) for contact in value)


class ForceTorqueContract(DeviceContract[ForceTorque]):
    """A raw wrench."""

    kind = DeviceKind.FORCE_TORQUE

    def read(self, rig: Rig[ForceTorque], duration_s: float = 2.0) -> Stamped[Any]:
        """A wrench."""
        return rig.device.read_wrench(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[ForceTorque], value: Any) -> None:
        """Finite and within the measuring range."""
        c = rig.device.capabilities()
        assert value.force_n.shape == value.torque_nm.shape == (3,)
        assert np.all(np.abs(value.force_n) <= c.force_range_n) and np.all(np.abs(value.torque_nm) <= c.torque_range_nm)


class LightsContract(DeviceContract[Lights]):
    """Switched lights with feedback."""

    kind = DeviceKind.LIGHTS

    def read(self, rig: Rig[Lights], duration_s: float = 2.0) -> Stamped[Any]:
        """The feedback of all channels."""
        return rig.device.read_on(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Lights], value: Any) -> None:
        """A bool a channel."""
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


CONTRACTS: dict[DeviceKind, type[DeviceContract[Any]]] = {
    contract.kind: contract
    for contract in (
        ArmContract,
        GripperContract,
        CameraContract,
        RangeScannerContract,
        ProximityContract,
        TouchContract,
        ForceTorqueContract,
        LightsContract,
    )
}


def _device_calls(kind: DeviceKind) -> tuple[str, ...]:
    """Methods of a kind's interface that go to the wire."""
    own = vars(PROTOCOLS[kind])
    return tuple(n for n in own if n.startswith(("read_", "command", "set_", "enable", "stop")) and callable(own[n]))


def _inward(arm: Arm, here: Any) -> Any:
    """Per joint, the direction that leads away from the nearer limit."""
    c = arm.capabilities()
    return np.where(here > 0.5 * (np.array(c.lower_rad) + np.array(c.upper_rad)), -1.0, 1.0)
