"""Fake devices without physics, found by name like any driver; they answer at once and can be made to fail."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from hal.calibration import CameraIntrinsics
from hal.clock import Deadline
from hal.devices import (
    ArmCapabilities,
    CameraCapabilities,
    DeviceKind,
    DhLink,
    ForceTorqueCapabilities,
    GripperCapabilities,
    GripperState,
    Health,
    Image,
    JointState,
    LightsCapabilities,
    ProximityCapabilities,
    RangeImage,
    RangeScannerCapabilities,
    TouchCapabilities,
    Wrench,
)
from hal.errors import ConfigError, DeviceTimeout, DeviceUnavailable
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context
from hal.simulated import Fault

# immortal: continues to work after `close`. trouble: a file with `crash` or `away`, in effect while it exists
# trace: a file that gets the first joint's set-points of an arm, and `stop`, each with its time on the monotonic clock
OPTIONS = {"fail", "crash_at_connect", "child_pid_file", "immortal", "trouble", "trace"}


class FakeDevice:
    """Base of all fakes: name, health, faults and stamps."""

    kind: DeviceKind

    def __init__(self, context: Context, options: dict[str, Any]) -> None:
        unknown = set(options) - OPTIONS
        if unknown:
            raise ConfigError(
                f"devices.{context.name}.options: unknown key {sorted(unknown)[0]!r}", hint=f"known: {sorted(OPTIONS)}"
            )
        if "fail" in options:
            raise DeviceUnavailable(f"{context.name}: {options['fail']}", hint="plug it in", device=context.name)
        if options.get("crash_at_connect"):
            raise ZeroDivisionError("planted defect")
        self.name = context.name
        self._trouble = Path(options["trouble"]) if "trouble" in options else None
        self._meet_trouble()
        self._clock = context.clock
        self._is_immortal = bool(options.get("immortal"))
        self._sequence = 0
        self._fault: Fault | None = None
        self._thawed = threading.Event()
        self._closed = False
        self._child = self._world(options["child_pid_file"]) if "child_pid_file" in options else None
        if self._child is not None:
            context.shared.get(f"world of {self.name}", lambda: self)

    @staticmethod
    def _world(pid_file: str) -> subprocess.Popen[bytes]:
        """Start a process of the device, as a simulator does, that does not end by itself."""
        code = f"import os,threading; open({pid_file!r}, 'w').write(str(os.getpid())); threading.Event().wait()"
        return subprocess.Popen([sys.executable, "-c", code])

    def health(self) -> Health:
        good = self._fault is None and not self._closed
        return Health(
            connected=not self._closed,
            quality=Quality.VALID if good else Quality.INVALID,
            cause=Cause.NONE if good else Cause.TIMEOUT,
            samples=self._sequence,
        )

    def close(self) -> None:
        self._closed = not self._is_immortal
        if self._child is not None:
            self._child.kill()
            self._child.wait()

    def why_ended(self) -> str | None:
        ended = not self._closed and self._child is not None and self._child.poll() is not None
        return "the fake world has ended" if ended else None

    def inject_fault(self, fault: Fault | None, *, magnitude: float = 0.0) -> None:
        self._fault = fault
        self._thawed.clear() if fault is Fault.FROZEN else self._thawed.set()

    def _meet_trouble(self) -> None:
        kind = self._trouble.read_text() if self._trouble is not None and self._trouble.exists() else ""
        if kind == "crash":
            ctypes.string_at(0)  # crashes like a C library with a bad pointer
        if kind == "away":
            raise DeviceUnavailable(f"{self.name} is not on its port", hint="plug it in", device=self.name)

    def _stamped(self, value: Any) -> Stamped[Any]:
        self._meet_trouble()
        if self._closed or self._fault is Fault.DISCONNECTED:
            raise DeviceUnavailable(f"{self.name} is disconnected", hint="plug it in", device=self.name)
        if self._fault is Fault.SILENT:
            raise DeviceTimeout(f"{self.name} is silent", hint="check power and cable", device=self.name)
        if self._fault is Fault.FROZEN:
            self._thawed.wait(60.0)  # ignores every deadline, as a bad SDK does
        self._sequence += 1
        return Stamped(value=value, host_time_s=self._clock.now_s(), sequence=self._sequence)


class FakeArm(FakeDevice):
    kind = DeviceKind.ARM

    def __init__(self, context: Context, options: dict[str, Any]) -> None:
        super().__init__(context, options)
        self._q = np.array([0.0, -1.2, 1.6, 0.0, 0.8, 0.0])
        self._trace = Path(options["trace"]) if "trace" in options else None

    def capabilities(self) -> ArmCapabilities:
        d = (0.40, 0.0, 0.0, 0.40, 0.0, 0.08)
        a = (0.0, 0.40, 0.0, 0.0, 0.0, 0.0)
        alpha = (-np.pi / 2, 0.0, np.pi / 2, -np.pi / 2, np.pi / 2, 0.0)
        return ArmCapabilities(
            model="fake",
            links=tuple(DhLink(d_m=x, a_m=y, alpha_rad=z) for x, y, z in zip(d, a, alpha, strict=True)),
            lower_rad=(-3.0,) * 6,
            upper_rad=(3.0,) * 6,
            velocity_rad_per_s=(2.0,) * 6,
            acceleration_rad_per_s2=(10.0,) * 6,
            tip_speed_m_per_s=1.0,
            command_rate_hz=250.0,
            link_radius_m=(0.06,) * 6,
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        return self._stamped(JointState(position_rad=self._q.copy(), velocity_rad_per_s=np.zeros(6)))

    def command_position(self, position_rad: Any, *, deadline: Deadline) -> Any:
        self._q = np.asarray(position_rad, float).copy()
        self._note(f"{self._q[0]:.6f}")
        return self._q.copy()

    def enable(self, *, deadline: Deadline) -> None:
        pass

    def stop(self, *, deadline: Deadline) -> None:
        self._note("stop")

    def _note(self, line: str) -> None:
        if self._trace is not None:
            with self._trace.open("a") as file:
                file.write(f"{line} {time.monotonic():.6f}\n")


class FakeGripper(FakeDevice):
    kind = DeviceKind.GRIPPER
    width_m = 0.05

    def capabilities(self) -> GripperCapabilities:
        return GripperCapabilities(min_width_m=0.0, max_width_m=0.085, max_force_n=40.0, max_speed_m_per_s=0.1)

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        return self._stamped(GripperState(width_m=self.width_m, force_n=0.0, is_moving=False, is_holding=False))

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        self.width_m = width_m
        return width_m


class FakeCamera(FakeDevice):
    kind = DeviceKind.CAMERA

    def capabilities(self) -> CameraCapabilities:
        lens = CameraIntrinsics(width_px=64, height_px=48, fx_px=60.0, fy_px=60.0, cx_px=31.5, cy_px=23.5)
        return CameraCapabilities(width_px=64, height_px=48, is_colour=True, rate_hz=30.0, nominal=lens)

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        row = np.linspace(0, 255, 64, dtype=np.uint8)
        return self._stamped(Image(pixels=np.broadcast_to(row[None, :, None], (48, 64, 3)).copy(), exposure_s=0.01))


class FakeRangeScanner(FakeDevice):
    kind = DeviceKind.RANGE_SCANNER

    def capabilities(self) -> RangeScannerCapabilities:
        return RangeScannerCapabilities(
            projection="pinhole", width=16, height=12, fx=20.0, fy=20.0, cx=7.5, cy=5.5, min_range_m=0.1,
            max_range_m=2.0, sigma_m=0.001, rate_hz=10.0,
        )  # fmt: skip

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        depth = np.full((12, 16), 0.5, np.float32)
        depth[0, 0] = np.nan
        return self._stamped(RangeImage(depth_m=depth))


class FakeProximity(FakeDevice):
    kind = DeviceKind.PROXIMITY

    def capabilities(self) -> ProximityCapabilities:
        return ProximityCapabilities(min_range_m=0.01, max_range_m=0.3, sigma_m=0.001, rate_hz=100.0)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        return self._stamped(float("nan") if self._fault is Fault.BIASED else 0.123)


class FakeTouch(FakeDevice):
    kind = DeviceKind.TOUCH

    def capabilities(self) -> TouchCapabilities:
        return TouchCapabilities(channels=("left", "right"), threshold_n=0.5, rate_hz=250.0)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        return self._stamped((False, False))


class FakeForceTorque(FakeDevice):
    kind = DeviceKind.FORCE_TORQUE

    def capabilities(self) -> ForceTorqueCapabilities:
        return ForceTorqueCapabilities(
            force_range_n=200.0, torque_range_nm=20.0, force_sigma_n=0.0, torque_sigma_nm=0.0, rate_hz=250.0
        )

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        return self._stamped(Wrench(force_n=np.zeros(3), torque_nm=np.zeros(3)))


class FakeLights(FakeDevice):
    kind = DeviceKind.LIGHTS
    on = (False,) * 4

    def capabilities(self) -> LightsCapabilities:
        return LightsCapabilities(channels=("a", "b", "c", "d"), settle_s=0.0)

    def set_on(self, on: Any, *, deadline: Deadline) -> tuple[bool, ...]:
        self.on = tuple(bool(v) for v in on)
        return self.on

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        return self._stamped(self.on)


connect_arm = FakeArm
connect_gripper = FakeGripper
connect_camera = FakeCamera
connect_range_scanner = FakeRangeScanner
connect_proximity = FakeProximity
connect_touch = FakeTouch
connect_force_torque = FakeForceTorque
connect_lights = FakeLights
