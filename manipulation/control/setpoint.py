"""The last filter between a motion and the drive, and the checks before a motion starts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.config import BoxSection
from hal.errors import MotionRefused
from hal.geometry import difference
from hal.motion import CartesianPath, DeclaredMotion, GripperMotion, Hold, JointTrajectory, Quantity
from manipulation.arm.kinematics import Kinematics
from manipulation.control import braking
from manipulation.control.sensing import DeviceFailure
from manipulation.control.workspace import Workspace

START_RAD = 0.05
START_M = 0.005
SPEED_SLACK = 1.05
RESTING_RAD_PER_S = 1e-4
BY_CONTACT = (Quantity.FORCE, Quantity.TORQUE, Quantity.FORCE_RISE)
SLOWING_M_PER_S2 = 2.0  # a lower limit of the tip's speed takes effect at this rate, so that the arm can follow it
BEHIND_M, BEHIND_TICKS = 0.002, 3  # a set-point that is so far behind the wanted one lets the motion's time stand still
ON_ITS_WAY_RAD = 1e-6
WAITS_S, NEARER_M = 1.0, 1e-4  # a motion waits so long for a set-point that does not come nearer by so much
LOOK_BACK_TICKS = 3  # with one, a jitter of 10 % in the ticks triples the following error of a steady motion


class SetPointLimiter:
    """Keeps set-points finite and within joint range, speed, acceleration, tip speed and workspace.

    It also keeps the set-point that was sent last.

    Args:
        tip_limit_m_per_s: that of the cell, for which motions are planned; `slow_to` sets a lower one.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        flange_from_tool: Array,
        tip_limit_m_per_s: float,
        dt_s: float,
        workspace: Sequence[BoxSection] = (),
    ) -> None:
        self._kinematics = kinematics
        self._tool = flange_from_tool
        self._full_m_per_s = self._tip_limit = tip_limit_m_per_s
        self._workspace = Workspace(workspace, kinematics, flange_from_tool, dt_s)
        self._dt_s = dt_s
        # While the time of a motion stands still: how near the set-point came to the wanted one, and how long ago.
        self._nearest_m, self._waited_s = np.inf, 0.0
        self._wanted_rad = np.zeros((LOOK_BACK_TICKS, len(kinematics.dh)))  # newest first
        self.last_rad = np.zeros(len(kinematics.dh))
        self.velocity_rad_per_s = np.zeros(len(kinematics.dh))

    def begin_at(self, measured_rad: Array) -> None:
        """Start from the measured position, which is the first set-point after every resume."""
        self.last_rad = np.clip(measured_rad, self._kinematics.lower_rad, self._kinematics.upper_rad)
        self.velocity_rad_per_s = np.zeros_like(measured_rad)
        self._wanted_rad[:] = self.last_rad

    def apply(self, wanted_rad: Array) -> Array:
        """Return the set-point that may be sent.

        Raises:
            DeviceFailure: the wanted set-point is not finite, or the tip would leave the workspace.
        """
        if not math.isfinite(wanted_rad @ wanted_rad):
            raise DeviceFailure("controller", "a set-point was not finite")
        out = self._step(wanted_rad)
        self._workspace.check(self.last_rad, out)
        return out

    def slow_to(self, limit_m_per_s: float) -> None:
        """Bring the limit of the tip's speed one tick nearer to a new one; at rest it holds at once."""
        limit = min(limit_m_per_s, self._full_m_per_s)
        change = np.inf if self.is_at_rest else SLOWING_M_PER_S2 * self._dt_s
        self._tip_limit = float(np.clip(limit, self._tip_limit - change, self._tip_limit + change))

    def waiting_share(self, wanted_rad: Array, out_rad: Array) -> float:
        """Return the share of a tick for which the motion's time must stand still, so that the set-point stays on its way.

        Otherwise the set-points of the motion would run ahead and the arm would cut its corners. That happens below the
        speed for which the motion is planned, and at that speed too: where a way just keeps the limit of the tip, the
        smallest excess slows each joint by its own share, and the arm left a planned way by 0.3 rad. A set-point that stands
        still, or comes no nearer for a second, is not waited for, because nothing would end its motion.
        """
        if self.is_at_rest or np.abs(wanted_rad - out_rad).max() < ON_ITS_WAY_RAD:
            self._nearest_m, self._waited_s = np.inf, 0.0
            return 0.0
        behind = self._workspace.tip_m(wanted_rad) - self._workspace.tip_m(out_rad)
        most_m = max(BEHIND_M, BEHIND_TICKS * self._full_m_per_s * self._dt_s)
        behind_m = float(np.linalg.norm(behind))
        if behind_m < most_m:
            self._nearest_m, self._waited_s = np.inf, 0.0
            return behind_m / most_m
        if behind_m < self._nearest_m - NEARER_M:
            self._nearest_m, self._waited_s = behind_m, 0.0
        self._waited_s += self._dt_s
        return 1.0 if self._waited_s <= WAITS_S else 0.0

    def _step(self, wanted_rad: Array) -> Array:
        kin = self._kinematics
        out: Array = braking.safe_step(
            kin.dh, self._tool, wanted_rad, self._wanted_rad, self.last_rad, self.velocity_rad_per_s,
            kin.velocity_rad_per_s, kin.acceleration_rad_per_s2, kin.lower_rad, kin.upper_rad, self._tip_limit,
            self._dt_s,
        )  # fmt: skip
        self._wanted_rad[1:] = self._wanted_rad[:-1]
        self._wanted_rad[0] = wanted_rad
        return out

    def brake(self) -> Array:
        """Return the set-point of a tick that only slows down, along the way on which the joints are.

        All joints slow down by the same share, as much as the limit of one of them allows. If each stopped as fast as it
        could, the tip would leave its way, and a pad that presses on something would be dragged along it.
        """
        way = self.velocity_rad_per_s * self._dt_s
        most = self._kinematics.acceleration_rad_per_s2 * self._dt_s**2
        share = min(1.0, float(np.min(most / np.maximum(np.abs(way), 1e-12))))
        wanted = self.last_rad + (1.0 - share) * way
        self._wanted_rad[:] = wanted
        return self._step(wanted)

    def sent(self, position_rad: Array) -> None:
        """Note the set-point that the arm reports as sent to its drives."""
        self.velocity_rad_per_s = (position_rad - self.last_rad) / self._dt_s
        self.last_rad = position_rad

    @property
    def is_at_rest(self) -> bool:
        """Whether the set-point stands still."""
        return bool(np.abs(self.velocity_rad_per_s).max() < RESTING_RAD_PER_S)


def check(motion: DeclaredMotion, kinematics: Kinematics, measured_rad: Array) -> None:
    """Refuse a motion that cannot be intended.

    Raises:
        MotionRefused: values not finite, times that do not rise, outside joint range or speed, or a start too far away.
    """
    match motion:
        case JointTrajectory():
            _check_trajectory(motion, kinematics, measured_rad)
            if motion.pads is not None:
                _check_pads(motion.pads)
        case CartesianPath():
            _check_path(motion, kinematics, measured_rad)
        case Hold():
            if not 0.0 <= motion.duration_s <= 60.0:
                raise _refused(motion, f"a hold of {motion.duration_s} s", "hold between 0 and 60 s")
        case GripperMotion():
            _check_pads(motion)


def is_retreat(motion: DeclaredMotion) -> bool:
    """Return whether the motion goes on when a sensor fails."""
    return not isinstance(motion, Hold) and motion.is_retreat


def check_is_felt(motion: DeclaredMotion, *, has_force_torque: bool) -> None:
    """Refuse a motion that ends or yields by contact forces in a cell that does not measure them.

    A retreat is not refused, because it ends a contact.

    Raises:
        MotionRefused: the motion watches a force, or is compliant, and there is no force/torque sensor.
    """
    is_compliant = isinstance(motion, CartesianPath) and motion.compliance is not None
    if (
        has_force_torque
        or is_retreat(motion)
        or not (is_compliant or any(guard.quantity in BY_CONTACT for guard in motion.guards))
    ):
        return
    what = "nothing measures the force of the contact that it makes"
    raise _refused(motion, what, "add a device of kind force_torque to the cell file")


def _check_pads(motion: GripperMotion) -> None:
    numbers = (motion.width_m, motion.force_n, motion.speed_m_per_s, motion.timeout_s)
    if not all(np.isfinite(n) and n >= 0.0 for n in numbers):
        raise _refused(motion, "a number is negative or not finite", "give width, force, speed and time")


def _check_trajectory(motion: JointTrajectory, kin: Kinematics, measured: Array) -> None:
    q, v = motion.positions_rad, motion.velocities_rad_per_s
    shape = (len(motion.times_s), len(kin.dh))
    if q.shape != shape or v.shape != shape:
        raise _refused(
            motion, f"positions {q.shape} and velocities {v.shape} for times and joints {shape}", "same rows"
        )
    _check_times(motion, motion.times_s)
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise _refused(motion, "a position or velocity is not finite", "plan again")
    if (q < kin.lower_rad - 1e-6).any() or (q > kin.upper_rad + 1e-6).any():
        raise _refused(motion, "a position lies outside the joint range", "plan inside the arm's limits")
    if (np.abs(v) > SPEED_SLACK * kin.velocity_rad_per_s).any():
        raise _refused(motion, "a velocity is above the joint limit", "slow the trajectory down")
    gap = float(np.abs(q[0] - measured).max())
    if gap > START_RAD:
        raise _refused(motion, f"starts {gap:.3f} rad away from the arm", "plan from the measured joints")


def _check_path(motion: CartesianPath, kin: Kinematics, measured: Array) -> None:
    _check_times(motion, motion.times_s)
    if len(motion.base_from_tool) != len(motion.times_s):
        raise _refused(
            motion, f"{len(motion.base_from_tool)} poses for {len(motion.times_s)} times", "give one pose per time"
        )
    places = np.array([pose.translation for pose in motion.base_from_tool])
    if not np.isfinite(places).all():
        raise _refused(motion, "a pose is not finite", "plan again")
    apart = difference(motion.base_from_tool[0], kin.tool(measured, motion.flange_from_tool))
    if np.linalg.norm(apart[:3]) > START_M or np.linalg.norm(apart[3:]) > START_RAD:
        raise _refused(
            motion,
            f"starts {1e3 * np.linalg.norm(apart[:3]):.1f} mm and {np.linalg.norm(apart[3:]):.3f} rad from the tool",
            "begin the path at the measured tool pose",
        )


def _check_times(motion: JointTrajectory | CartesianPath, times_s: Array) -> None:
    rising = (
        np.isfinite(times_s).all() and len(times_s) >= 2 and abs(times_s[0]) < 1e-9 and (np.diff(times_s) > 0).all()
    )
    if not rising:
        raise _refused(motion, "times must be finite, begin at 0 and rise", "plan again")


def _refused(motion: DeclaredMotion, what: str, hint: str) -> MotionRefused:
    return MotionRefused(f"motion {motion.name!r} refused: {what}", hint=hint, motion=motion.name)


def flange_matrix(pose: RigidTransform) -> Array:
    """Return a pose as the contiguous (4, 4) array that the kernels take."""
    return np.ascontiguousarray(pose.as_matrix())
