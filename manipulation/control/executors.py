"""One executor per kind of declared motion: it computes the set-point of each tick and says when the motion is over."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from hal.arrays import Array
from hal.clock import Clock, Deadline
from hal.devices import Gripper
from hal.errors import CellError
from hal.motion import CartesianPath, Compliance, GripperMotion, Hold, JointTrajectory
from manipulation.arm import kernels as arm_kernels
from manipulation.arm.kinematics import Kinematics
from manipulation.control import kernels
from manipulation.control.sensing import DeviceFailure, Sample, command_wait_s, refuse
from manipulation.plausibility.hand import wrong_width

BLEND_S = 0.25  # the gap between the declared and the measured start is closed over this time
TURN_ARM_M = 0.1  # a turn of 1 rad counts as this much distance
DAMPING = 1e-3  # of the damped least squares; strokes are planned clear of singularities
DEMAND_S, MOST_DEMANDS = 0.01, 400  # the demand of a path on the joints is computed at this interval
USABLE = 0.9  # share of the joint limits that it may ask for; compliance and the closing of the gap need the rest
SMALL_BEND_RAD = 0.2  # between samples of an arc; more is a corner
MOST_STRETCH = 4.0  # more only happens next to a singularity
GRIP_START_S, GRIP_REST_S = 0.08, 0.05  # a gripper needs the first to report that it moves, and rests for the second
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """Inputs of an executor: time since its start, sample, contact wrench (6,) in tool axes, last set-point."""

    elapsed_s: float
    sample: Sample
    wrench: Array
    last_rad: Array
    dt_s: float


class Executor(Protocol):
    """A motion in execution."""

    def wanted(self, tick: Tick) -> Array:
        """Return the joint set-point (n,) for this tick."""
        ...

    def is_over(self, tick: Tick) -> bool:
        """Return whether the declared motion has run to its end."""
        ...

    @property
    def pads(self) -> GripperExecutor | None:
        """The motion of the pads, if they move."""
        ...


class TrajectoryExecutor:
    """Interpolates the declared joint states by cubic Hermite polynomials, blended from the measured start."""

    def __init__(self, motion: JointTrajectory, start_rad: Array, pads: GripperExecutor | None = None) -> None:
        self.pads = pads
        self._t = motion.times_s
        self._q, self._v = motion.positions_rad, motion.velocities_rad_per_s
        self._gap = start_rad - motion.positions_rad[0]

    def wanted(self, tick: Tick) -> Array:
        """Return the point of the trajectory at this time."""
        q: Array = kernels.hermite(self._t, self._q, self._v, tick.elapsed_s)
        return np.asarray(q + self._gap * _fade(tick.elapsed_s))

    def is_over(self, tick: Tick) -> bool:
        """Return whether the declared time has passed and the pads rest."""
        rests = self.pads is None or self.pads.is_over(tick)
        return rests and bool(tick.elapsed_s >= self._t[-1])


class PathExecutor:
    """Follows tool poses in time; with compliance, an admittance in tool axes lets the tool yield about them."""

    pads = None

    def __init__(self, motion: CartesianPath, kinematics: Kinematics, start_rad: Array) -> None:
        poses = motion.base_from_tool
        self._dh = kinematics.dh
        self._tool = np.ascontiguousarray(motion.flange_from_tool.as_matrix())
        self._t = np.ascontiguousarray(motion.times_s, float)
        matrices = np.array([pose.as_matrix() for pose in poses])
        self._p, self._r = np.ascontiguousarray(matrices[:, :3, 3]), np.ascontiguousarray(matrices[:, :3, :3])
        turns = Rotation.from_matrix(self._r)
        self._w = np.asarray((turns[1:] * turns[:-1].inv()).as_rotvec()).reshape(-1, 3)
        self._ways, self._speeds = smooth_ways(self._t, self._p, self._w)
        self._rates = leg_velocities(self._t, self._p, self._ways, self._speeds)
        self._slow_down(kinematics, start_rad)
        first = np.ascontiguousarray(poses[0].as_matrix())
        measured, _ = arm_kernels.tool_and_jacobian(self._dh, start_rad, self._tool)
        self._gap = arm_kernels.pose_error(measured, first)
        self._admittance = None if motion.compliance is None else Admittance(motion.compliance)

    def _slow_down(self, kinematics: Kinematics, start_rad: Array) -> None:
        """Stretch the times of a path that asks a joint for more speed or acceleration than it has.

        A set-point that trails behind the path is where nobody has planned it.
        """
        step_s = max(DEMAND_S, float(self._t[-1]) / MOST_DEMANDS)
        demand: Array = kernels.path_demand(
            self._dh,
            self._tool,
            self._t,
            self._ways,
            self._speeds,
            self._p,
            self._rates,
            self._r,
            self._w,
            start_rad,
            DAMPING,
            step_s,
        )
        faster = np.max(demand[0] / kinematics.velocity_rad_per_s)
        harder = np.sqrt(np.max(demand[1] / kinematics.acceleration_rad_per_s2))
        stretch = float(np.clip(max(faster, harder) / USABLE, 1.0, MOST_STRETCH))
        self._t = stretch * self._t
        self._speeds, self._rates = self._speeds / stretch, self._rates / stretch

    def wanted(self, tick: Tick) -> Array:
        """Return the joints whose tool pose is the path's, displaced by the admittance."""
        offset = np.zeros(6) if self._admittance is None else self._admittance.step(tick.wrench, tick.dt_s)
        shift = self._gap * _fade(tick.elapsed_s)
        q: Array = kernels.path_joints(
            self._dh,
            self._tool,
            self._t,
            self._ways,
            self._speeds,
            self._p,
            self._rates,
            self._r,
            self._w,
            tick.elapsed_s,
            shift,
            offset,
            tick.last_rad,
            DAMPING,
        )
        return q

    def is_over(self, tick: Tick) -> bool:
        """Return whether the declared time has passed."""
        return bool(tick.elapsed_s >= self._t[-1])


def smooth_ways(times_s: Array, points: Array, turns: Array) -> tuple[Array, Array]:
    """Return the distance (N,) along a path of points (N, 3) and turns (N - 1, 3), and the speed (N,) at each point.

    The path begins and ends at rest. At inner points the speed is that of a spline, so that the acceleration has no step,
    but at most three times the lower of the neighbouring speeds, so that the cubic does not run backwards.

    Source: Fritsch and Carlson, SIAM J. Numer. Anal. 17(2), 1980.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1) + TURN_ARM_M * np.linalg.norm(turns, axis=1)
    rates = lengths / np.diff(times_s)
    ways = np.concatenate([[0.0], np.cumsum(lengths)])
    speeds: Array = CubicSpline(times_s, ways, bc_type="clamped")(times_s, 1)
    speeds[1:-1] = np.clip(speeds[1:-1], 0.0, 3.0 * np.minimum(rates[:-1], rates[1:]))
    speeds[0] = speeds[-1] = 0.0
    return ways, speeds


def leg_velocities(times_s: Array, points: Array, ways: Array, speeds: Array) -> Array:
    """Return the velocities (2, N - 1, 3) at the begin and the end of each leg between points (N, 3).

    Where the path bends by little they are those of a spline, because each bend is a step of the velocity otherwise.
    Legs that meet at a corner keep their directions, at the speeds (N,) along the ways (N,).
    """
    legs = np.diff(points, axis=0)
    per_way = legs / np.maximum(np.diff(ways), 1e-12)[:, None]
    rates = np.array([per_way * speeds[:-1, None], per_way * speeds[1:, None]])
    along = legs / np.maximum(np.linalg.norm(legs, axis=1, keepdims=True), 1e-12)
    cosines = np.einsum("ij,ij->i", along[:-1], along[1:])
    bends = np.flatnonzero(cosines > np.cos(SMALL_BEND_RAD))
    smooth = CubicSpline(times_s, points, bc_type="clamped")(times_s, 1)
    rates[1, bends], rates[0, bends + 1] = smooth[bends + 1], smooth[bends + 1]
    return rates


class Admittance:
    """A virtual mass, damper and spring on each tool axis; its offset (6,) is added to the path in tool axes."""

    def __init__(self, compliance: Compliance) -> None:
        self._k = np.array(compliance.stiffness)
        self._d = np.array(compliance.damping)
        self._m = np.array(compliance.mass)
        self._target = np.array(compliance.target_wrench)
        self._bound = np.array([compliance.max_offset_m] * 3 + [compliance.max_offset_rad] * 3)
        self._state = np.zeros((2, 6))

    def step(self, wrench: Array, dt_s: float) -> Array:
        """Advance by one tick under the contact wrench; returns the offset (6,)."""
        kernels.admittance_step(self._state, wrench - self._target, self._k, self._d, self._m, self._bound, dt_s)
        return np.array(self._state[0])


class HoldExecutor:
    """Keeps the arm where it is."""

    pads = None

    def __init__(self, motion: Hold) -> None:
        self._duration_s = motion.duration_s

    def wanted(self, tick: Tick) -> Array:
        """Return the last set-point."""
        return tick.last_rad

    def is_over(self, tick: Tick) -> bool:
        """Return whether the declared time has passed."""
        return tick.elapsed_s >= self._duration_s


class GripperExecutor:
    """Holds the arm while the pads move; it is over when they rest."""

    def __init__(self, motion: GripperMotion, gripper: Gripper, sample: Sample, clock: Clock) -> None:
        self._motion, self._gripper, self._clock = motion, gripper, clock
        self._resting_since_s: float | None = None
        self.pads = self
        self.begun_m = sample.gripper_width_m
        self._sent_m = self._move_to(motion.width_m)

    def _move_to(self, width_m: float) -> float:
        wanted = self._motion
        deadline = Deadline.after(self._clock, command_wait_s(self._clock))
        return self._gripper.command(
            width_m=width_m, force_n=wanted.force_n, speed_m_per_s=wanted.speed_m_per_s, deadline=deadline
        )

    def halt(self, sample: Sample, elapsed_s: float) -> str | None:
        """Stop the pads where they are, unless they rest already: an early end of the motion applies to them too.

        Returns why they were not stopped, None if they were.
        """
        if not sample.gripper_is_moving and elapsed_s >= GRIP_START_S:
            return None
        try:
            self._move_to(sample.gripper_width_m)
        except CellError as error:  # the gripper may be the device that failed
            return f"{self._gripper.name}: {error.what}"
        except Exception as defect:  # a defect of the driver must not keep the arm from coming to rest
            log.exception("halting %s", self._gripper.name)
            return f"{self._gripper.name}: {type(defect).__name__}: {defect}"
        return None

    def check_end(self, sample: Sample) -> None:
        """Check that pads which hold nothing have reached the width that they were sent to.

        Raises:
            DeviceFailure: the reported width contradicts the command.
        """
        if self._motion.must_arrive:
            refuse(wrong_width(self._gripper.name, sample.pads, sent_m=self._sent_m, begun_m=self.begun_m))

    def wanted(self, tick: Tick) -> Array:
        """Return the last set-point."""
        return tick.last_rad

    def is_over(self, tick: Tick) -> bool:
        """Return whether the pads have rested for a moment, or the time is over."""
        if tick.sample.gripper_is_moving or tick.elapsed_s < GRIP_START_S:
            self._resting_since_s = None
        elif self._resting_since_s is None:
            self._resting_since_s = tick.elapsed_s
        rested = self._resting_since_s is not None and tick.elapsed_s - self._resting_since_s >= GRIP_REST_S
        return rested or tick.elapsed_s >= self._motion.timeout_s


def begin(
    motion: JointTrajectory | CartesianPath | Hold | GripperMotion,
    kinematics: Kinematics,
    gripper: Gripper,
    sample: Sample,
    clock: Clock,
) -> Executor:
    """Return the executor of a motion that starts at the measured joints of `sample`.

    Raises:
        DeviceFailure: the gripper did not accept its command.
    """
    try:
        match motion:
            case JointTrajectory():
                pads = None if motion.pads is None else GripperExecutor(motion.pads, gripper, sample, clock)
                return TrajectoryExecutor(motion, sample.position_rad, pads)
            case CartesianPath():
                return PathExecutor(motion, kinematics, sample.position_rad)
            case Hold():
                return HoldExecutor(motion)
            case GripperMotion():
                return GripperExecutor(motion, gripper, sample, clock)
    except CellError as error:
        raise DeviceFailure(str(error.details.get("device", gripper.name)), error.what) from error


def _fade(elapsed_s: float) -> float:
    """Return a weight that falls smoothly from 1 at the start to 0 after BLEND_S."""
    u = min(1.0, elapsed_s / BLEND_S)
    return 1.0 - u * u * (3.0 - 2.0 * u)
