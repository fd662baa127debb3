"""Declared motions: a skill specifies the motion, its force limits and what ends it; the cell executes it.

All poses are `base_from_tool`, where `flange_from_tool` comes with the motion. Wrenches are contact wrenches (bias and
tool weight subtracted) in tool axes about the tool's origin: the wrench that the environment exerts on the tool.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from scipy.spatial.transform import RigidTransform

from hal.arrays import Array

STOPPING_S = 0.012
"""Time in which a force still rises after a guard has seen it: two control ticks, and the arm's braking at its limit."""


class Quantity(StrEnum):
    """The quantity that a guard watches."""

    FORCE = "force"  # N, along `axis` of the tool, or the norm when the axis is None
    RESISTANCE = "resistance"  # N, norm of the force without what pushes the tip the way it is commanded to go
    TORQUE = "torque"  # N m, likewise, as the force
    FORCE_RISE = "force-rise"  # N above the running median of the last 0.4 s, along `axis` or the norm
    TOUCH = "touch"  # number of channels in contact
    PROXIMITY = "proximity"  # m, nearest of all valid proximity readings
    TRAVEL = "travel"  # m, of the tip since the motion's start (along `axis` of the start tool frame, or the norm)
    ROTATION = "rotation"  # rad, turn of the tool since the start
    TRACKING = "tracking"  # m, distance between commanded and measured tip


class Reaction(StrEnum):
    """The reaction when a guard trips."""

    STOP = "stop"  # decelerate, hold, outcome `guard`
    FAULT = "fault"  # the same, but the motion counts as failed (protective)


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """Trips when the quantity is at or beyond `limit` for `ticks` control ticks (below it when `below`).

    With `ahead_s`, a force counts with what soft pads add to it in that time, which the arm takes to stop, at the speed that
    the tip is commanded to.
    """

    name: str
    quantity: Quantity
    limit: float
    axis: tuple[float, float, float] | None = None
    below: bool = False
    ticks: int = 2
    reaction: Reaction = Reaction.STOP
    ahead_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Compliance:
    """Admittance in tool axes (x, y, z, rx, ry, rz): contact wrenches make the tool deviate from the declared path.

    The deviation x obeys mass a + damping v + stiffness x = wrench - target. An axis with stiffness `inf` does not
    deviate.
    """

    stiffness: tuple[float, float, float, float, float, float]
    damping: tuple[float, float, float, float, float, float]
    mass: tuple[float, float, float, float, float, float] = (20.0, 20.0, 20.0, 0.5, 0.5, 0.5)
    target_wrench: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    max_offset_m: float = 0.03
    max_offset_rad: float = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLimits:
    """Limits of one motion besides those of the cell, of which the stricter holds; None sets none.

    Attributes:
        speed_m_per_s: largest speed of the tool's tip. The motion is made more slowly, along the same way.
        force_n: largest contact force.
    """

    speed_m_per_s: float | None = None
    force_n: float | None = None


NO_LIMITS = MotionLimits()


@dataclass(frozen=True, slots=True, kw_only=True)
class CellSignals:
    """What the control thread asks in each tick besides the stop latch.

    Attributes:
        is_reduced: whether people are near, so that the reduced speed holds.
        keeps_power: whether a latched stop leaves the drives on, so that they hold the arm.
        goes_back: whether a motion that a latched stop ends is followed by the way back, because the service is lost.
    """

    is_reduced: Callable[[], bool] = lambda: False
    keeps_power: Callable[[], bool] = lambda: False
    goes_back: Callable[[], bool] = lambda: False


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperMotion:
    """Move the pads while the arm holds its pose or makes a trajectory; ends when they rest or after `timeout_s`.

    With `must_arrive`, it is a gripper fault if the pads hold nothing and stand still at another width. With
    `is_retreat`, a sensor other than the gripper that fails does not end the motion.
    """

    name: str
    width_m: float
    force_n: float
    speed_m_per_s: float = 0.08
    timeout_s: float = 3.0
    must_arrive: bool = True
    guards: tuple[Guard, ...] = ()
    is_retreat: bool = False
    limits: MotionLimits = NO_LIMITS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointTrajectory:
    """Joint positions (N, n) rad at times (N,) s from 0, with velocities (N, n) rad/s: cubic Hermite between them.

    `pads` moves the pads meanwhile; the motion ends when arm and pads have arrived. Its guards are not used.
    With `is_retreat`, a sensor that fails does not end the motion; see `CartesianPath`.
    """

    name: str
    times_s: Array
    positions_rad: Array
    velocities_rad_per_s: Array
    guards: tuple[Guard, ...] = ()
    pads: GripperMotion | None = None
    is_retreat: bool = False
    limits: MotionLimits = NO_LIMITS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CartesianPath:
    """Tool poses at times (N,) s from 0; between neighbours a straight line and a rotation at constant rate.

    The first pose must be where the tool is (within 5 mm and 0.05 rad): the executor blends from the measured pose.

    With `is_retreat`, the path leads away from what the hand may touch. It needs the arm only: a force, touch, gripper or
    proximity sensor that fails does not end it, the report's `cause` names that sensor, and a wrench that is not
    measured counts as zero.
    """

    name: str
    flange_from_tool: RigidTransform
    times_s: Array
    base_from_tool: tuple[RigidTransform, ...]
    guards: tuple[Guard, ...] = ()
    compliance: Compliance | None = None
    is_retreat: bool = False
    limits: MotionLimits = NO_LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class Hold:
    """Stand still for a time, for example until lamps have settled."""

    name: str
    duration_s: float
    guards: tuple[Guard, ...] = ()
    limits: MotionLimits = NO_LIMITS


DeclaredMotion = JointTrajectory | CartesianPath | Hold | GripperMotion


class MotionOutcome(StrEnum):
    """How a declared motion ended."""

    COMPLETED = "completed"
    GUARD = "guard"
    STOPPED = "stopped"  # the stop latch
    CANCELLED = "cancelled"
    FAULT = "fault"  # a device failed or a protective guard tripped; `cause` says which


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionLog:
    """Record of a motion, sampled every `1/rate_hz`: times (N,), joints (N, n), contact wrench in tool axes (N, 6),
    tip (N, 3); `started_s` is the cell clock's time of the first sample."""

    times_s: Array
    positions_rad: Array
    wrench: Array
    tip_m: Array
    started_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactForce:
    """Impulse of the contact force over a motion, and the sums for its chatter, from all control ticks.

    Attributes:
        impulse_n_s: integral of the force over the time in contact.
        changes: number of ticks in contact that follow a tick in contact; `squares_n2` sums the squared changes of the
            force from tick to tick over them.
    """

    impulse_n_s: float = 0.0
    changes: int = 0
    squares_n2: float = 0.0

    @property
    def chatter_n(self) -> float:
        """Root mean square of the change of the force from tick to tick in contact, N."""
        return math.sqrt(self.squares_n2 / self.changes) if self.changes else 0.0

    def __add__(self, other: ContactForce) -> ContactForce:
        return ContactForce(
            impulse_n_s=self.impulse_n_s + other.impulse_n_s,
            changes=self.changes + other.changes,
            squares_n2=self.squares_n2 + other.squares_n2,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionReport:
    """Result of a motion; `tripped` names the guard, `device` the failed device; `cause` explains it in a sentence."""

    name: str
    outcome: MotionOutcome
    tripped: str | None
    cause: str
    started_s: float
    ended_s: float
    position_rad: Array
    base_from_tool: RigidTransform
    wrench: Array  # (6,) contact wrench at the end, tool axes
    peak_force_n: float
    gripper_width_m: float | None
    log: MotionLog
    device: str | None = None
    force: ContactForce = field(default_factory=ContactForce)

    @property
    def duration_s(self) -> float:
        """Duration in seconds on the cell's clock."""
        return self.ended_s - self.started_s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotState:
    """Snapshot of the cell for reads that do not move: joints, flange, contact wrench, contacts, proximity."""

    stamp_s: float
    position_rad: Array
    velocity_rad_per_s: Array
    base_from_flange: RigidTransform
    wrench: Array  # (6,) contact wrench in flange axes about the flange, N and N m
    contacts: tuple[bool, ...]
    proximity_m: tuple[float, ...]
    gripper_width_m: float
    is_moving: bool
    is_stopped: bool
    faults: tuple[str, ...] = field(default=())


class Mover(Protocol):
    """The cell's motion port: one motion at a time."""

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Run the motion and wait for its end; events during the motion are not raised but given in the report.

        Raises:
            MotionRefused: not finite, outside limits, start pose too far away, or another motion runs.
            Stopped: the stop latch is set.
        """
        ...

    def cancel(self) -> None:
        """Decelerate and end the running motion with outcome `cancelled`; returns at once."""
        ...

    def tare(self) -> Array:
        """Take the present wrench (averaged over 0.1 s at rest) as zero contact, and return the (6,) bias found."""
        ...

    def state(self) -> RobotState:
        """Return the newest snapshot."""
        ...
