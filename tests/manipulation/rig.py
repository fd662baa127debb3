"""Small kinematic cell in numpy: an arm that reaches its set-points, a soft wall, a gripper, and optional faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.calibration import ToolLoad
from hal.clock import Deadline, SimClock
from hal.config import SafetySection
from hal.devices import (
    ArmCapabilities,
    DeviceKind,
    ForceTorqueCapabilities,
    GripperCapabilities,
    GripperState,
    Health,
    JointState,
    ProximityCapabilities,
    TouchCapabilities,
    Wrench,
)
from hal.errors import DeviceTimeout, DeviceUnavailable
from hal.geometry import transform_rpy
from hal.motion import CellSignals
from hal.readings import Cause, Quality, Stamped
from manipulation.arm.kinematics import Kinematics
from manipulation.control.controller import Controller
from manipulation.control.sensing import MotionDevices
from tests.manipulation.arms import T3

GRIP = transform_rpy((0.0, 0.0, 0.2), (0.0, 0.0, 0.0))
SENSOR = transform_rpy((0.0, 0.0, 0.02), (0.1, -0.2, 0.3))
LOAD = ToolLoad(mass_kg=0.9, centre_of_mass_m=(0.01, 0.0, 0.09), bias=(1.0, -2.0, 0.5, 0.02, 0.0, -0.01))
FRAMES = Kinematics.of(T3)  # verified by the independent reference in test_kinematics
HOME = np.array([0.0, 0.6, 0.3, 0.2, 0.7, 0.1])


@dataclass
class World:
    """Joints, a wall at `wall_x_m` with stiffness `k`, and the faults."""

    clock: SimClock = field(default_factory=SimClock)
    q: np.ndarray = field(default_factory=HOME.copy)
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(6))
    target: np.ndarray = field(default_factory=HOME.copy)
    width_m: float = 0.05
    width_target_m: float = 0.05
    wall_x_m: float = np.inf
    wall_n_per_m: float = 5000.0
    stride_rad: float | None = None  # the arm rejects set-points further than this from the previous one
    bias_rad: float = 0.0  # error of the arm's joint readings
    enabled: bool = False
    commands: list[np.ndarray] = field(default_factory=list)
    silent: set[str] = field(default_factory=set)
    frozen: set[str] = field(default_factory=set)
    repeating: set[str] = field(default_factory=set)  # devices that repeat one reading with new stamps
    defective: set[str] = field(default_factory=set)
    before_step: Callable[[], None] = lambda: None
    ticks: int = 0
    stops: int = 0

    def __post_init__(self) -> None:
        self.clock.attach(self.advance)

    def advance(self, duration_s: float) -> float:
        """Advance by one tick: the arm reaches its set-point, and the pads move slowly to their width."""
        self.before_step()
        self.velocity = (self.target - self.q) / duration_s
        self.q = self.target.copy()
        step = 0.1 * duration_s
        self.width_m += float(np.clip(self.width_target_m - self.width_m, -step, step))
        self.ticks += 1
        return self.clock.now_s() + duration_s

    def tip(self) -> np.ndarray:
        """Return (4, 4) base_from_grip."""
        return FRAMES.flange(self.q).as_matrix() @ GRIP.as_matrix()

    def contact_force(self) -> np.ndarray:
        """Return the force of the wall on the tip, in base axes."""
        depth = self.tip()[0, 3] - self.wall_x_m
        return np.array([-self.wall_n_per_m * max(0.0, depth), 0.0, 0.0])

    def wrench(self) -> np.ndarray:
        """Return the raw wrench in sensor axes: contact at the tip, weight at the centre of mass, bias."""
        sensor = FRAMES.flange(self.q).as_matrix() @ SENSOR.as_matrix()
        rotation = sensor[:3, :3].T
        weight = rotation @ np.array([0.0, 0.0, -9.80665 * LOAD.mass_kg])
        force = rotation @ self.contact_force()
        at = rotation @ (self.tip()[:3, 3] - sensor[:3, 3])
        torque = np.cross(at, force) + np.cross(LOAD.centre_of_mass_m, weight)
        return np.concatenate([force + weight, torque]) + np.asarray(LOAD.bias)


class _Device:
    kind: DeviceKind

    def __init__(self, name: str, world: World) -> None:
        self.name = name
        self.world = world
        self._frozen_at_s = 0.0

    def health(self) -> Health:
        return Health(connected=True, quality=Quality.VALID, cause=Cause.NONE)

    def close(self) -> None:
        return None

    def stamped(self, value):
        if self.name in self.world.silent:
            raise DeviceTimeout(f"{self.name} silent", hint="check power", device=self.name)
        if self.name in self.world.defective:
            raise ZeroDivisionError("a defect of the driver")
        now_s = self.world.clock.now_s()
        if self.name not in self.world.frozen:
            self._frozen_at_s = now_s
        return Stamped(value=value, host_time_s=self._frozen_at_s, sequence=self.world.ticks)


class FakeArm(_Device):
    kind = DeviceKind.ARM

    def capabilities(self) -> ArmCapabilities:
        return T3

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        if self.name not in self.world.repeating:
            said = self.world.q + self.world.bias_rad
            self._kept = JointState(position_rad=said, velocity_rad_per_s=self.world.velocity.copy())
        return self.stamped(self._kept)

    def command_position(self, position_rad: np.ndarray, *, deadline: Deadline) -> np.ndarray:
        if not self.world.enabled:
            raise DeviceUnavailable("arm is not enabled", hint="enable", device=self.name)
        sent = position_rad.copy()
        if self.world.stride_rad is not None:  # as drives do that know their position
            sent = np.clip(sent, self.world.target - self.world.stride_rad, self.world.target + self.world.stride_rad)
        self.world.commands.append(sent)
        self.world.target = sent
        return sent

    def enable(self, *, deadline: Deadline) -> None:
        self.world.enabled = True

    def stop(self, *, deadline: Deadline) -> None:
        self.world.enabled = False
        self.world.target = self.world.q.copy()
        self.world.stops += 1


class FakeGripper(_Device):
    kind = DeviceKind.GRIPPER

    def capabilities(self) -> GripperCapabilities:
        return GripperCapabilities(min_width_m=0.0, max_width_m=0.08, max_force_n=100.0, max_speed_m_per_s=0.1)

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        moving = abs(self.world.width_target_m - self.world.width_m) > 1e-6
        return self.stamped(GripperState(width_m=self.world.width_m, force_n=0.0, is_moving=moving, is_holding=False))

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        self.stamped(None)  # raises if the device is silent or broken, because it accepts no command then
        self.world.width_target_m = width_m
        return width_m


class FakeForceTorque(_Device):
    kind = DeviceKind.FORCE_TORQUE

    def capabilities(self) -> ForceTorqueCapabilities:
        return ForceTorqueCapabilities(
            force_range_n=300, torque_range_nm=30, force_sigma_n=0.3, torque_sigma_nm=0.01, rate_hz=500
        )

    _kept = np.zeros(6)

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        if self.name not in self.world.repeating:
            self._kept = self.world.wrench() + 1e-9 * (
                self.world.ticks % 2
            )  # the smallest change by the noise of a working sensor
        w = self._kept
        return self.stamped(Wrench(force_n=w[:3], torque_nm=w[3:]))


class FakeTouch(_Device):
    kind = DeviceKind.TOUCH

    def capabilities(self) -> TouchCapabilities:
        return TouchCapabilities(channels=("left", "right"), threshold_n=0.5, rate_hz=500)

    def read_contacts(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        touching = bool(np.linalg.norm(self.world.contact_force()) > 0.5)
        return self.stamped((touching, False))


class FakeProximity(_Device):
    kind = DeviceKind.PROXIMITY

    def capabilities(self) -> ProximityCapabilities:
        return ProximityCapabilities(min_range_m=0.0, max_range_m=0.1, sigma_m=0.0005, rate_hz=500)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        distance = self.world.wall_x_m - self.world.tip()[0, 3]
        if distance <= 0.1:
            return self.stamped(float(distance))
        reading = self.stamped(float("nan"))
        return Stamped(
            value=reading.value, host_time_s=reading.host_time_s, sequence=reading.sequence, quality=Quality.INVALID,
            cause=Cause.OUT_OF_RANGE,
        )  # fmt: skip


@dataclass
class Rig:
    """Controller of a `World`."""

    world: World
    controller: Controller
    latched: list[bool]
    near: list[bool] = field(default_factory=lambda: [False])  # whether people are
    held: list[bool] = field(default_factory=lambda: [False])  # whether a stop leaves the drives on
    back: list[bool] = field(default_factory=lambda: [False])  # whether a stop lets the arm go back


def make_rig(
    *, force_limit_n: float = 100.0, speed_limit_m_per_s: float = 0.25, safety: SafetySection | None = None
) -> Rig:
    """Return a started controller; the caller must close `rig.controller`."""
    world, latched, near, held, back = World(), [False], [False], [False], [False]
    controller = Controller(
        MotionDevices(
            arm=FakeArm("arm", world),
            gripper=FakeGripper("gripper", world),
            force_torque=FakeForceTorque("wrist_ft", world),
            touch=FakeTouch("finger_touch", world),
            proximities=(FakeProximity("proximity_left", world),),
        ),
        clock=world.clock,
        safety=safety or SafetySection(force_limit_n=force_limit_n, speed_limit_m_per_s=speed_limit_m_per_s),
        load=LOAD,
        flange_from_sensor=SENSOR,
        is_latched=lambda: latched[0],
        signals=CellSignals(is_reduced=lambda: near[0], keeps_power=lambda: held[0], goes_back=lambda: back[0]),
        flange_from_grip=GRIP,
        rate_hz=500.0,
    )
    controller.start()
    return Rig(world, controller, latched, near, held, back)


def tool_pose(q: np.ndarray) -> RigidTransform:
    """Return base_from_grip for joint positions."""
    return FRAMES.tool(q, GRIP)
