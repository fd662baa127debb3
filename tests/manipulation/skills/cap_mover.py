"""A numpy cell with one sprung cap on a plate, in which the motions of pressing really happen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.geometry import interpolate
from hal.motion import (
    CartesianPath,
    DeclaredMotion,
    JointTrajectory,
    MotionLog,
    MotionOutcome,
    MotionReport,
    Quantity,
    RobotState,
)
from hal.panel import Button, Mushroom
from hal.panel.parts import LATCHED_SHARE
from manipulation.arm.kinematics import Kinematics
from tests.manipulation.arms import T3
from tests.manipulation.rig import HOME

STIFF_N_PER_M = 20_000.0  # of pads against a plate or a cap at its stop
SAMPLES = 150
FRAMES = Kinematics.of(T3)


@dataclass
class CapMover:
    """Executes motions at once; a cap under the tips gives way, latches and pushes back; elsewhere is the plate.

    Attributes:
        base_from_panel: the true pose.
        stuck_at_m: depth at which something stops the cap; its travel when free.
    """

    cap: Button | Mushroom
    base_from_panel: RigidTransform
    flange_from_grip: RigidTransform
    latches: bool
    releases: bool = True
    is_latched: bool = False
    is_gone: bool = False
    stuck_at_m: float = np.inf
    presses: int = 0
    is_in: bool = False
    q: Array = field(default_factory=HOME.copy)
    asked: list[str] = field(default_factory=list)
    stamp_s: float = 0.0

    def cancel(self) -> None:
        return None

    def tare(self) -> Array:
        return np.zeros(6)

    def state(self) -> RobotState:
        return RobotState(
            stamp_s=self.stamp_s, position_rad=self.q, velocity_rad_per_s=np.zeros(6),
            base_from_flange=FRAMES.flange(self.q), wrench=np.zeros(6), contacts=(), proximity_m=(),
            gripper_width_m=0.0, is_moving=False, is_stopped=False,
        )  # fmt: skip

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        self.asked.append(motion.name)
        self.stamp_s += 1.0
        tips, forces, tripped = np.empty((0, 3)), np.empty(0), None
        if isinstance(motion, JointTrajectory):
            self.q = motion.positions_rad[-1]
        elif isinstance(motion, CartesianPath):
            tips, forces, tripped = self._follow(motion)
        wrench = np.zeros((len(forces), 6))
        wrench[:, 2] = -forces
        log = MotionLog(
            times_s=np.arange(len(forces)) * 0.008, positions_rad=np.tile(self.q, (len(forces), 1)), wrench=wrench,
            tip_m=tips,
        )  # fmt: skip
        return MotionReport(
            name=motion.name, outcome=MotionOutcome.COMPLETED if tripped is None else MotionOutcome.GUARD,
            tripped=tripped, cause="", started_s=self.stamp_s - 1.0, ended_s=self.stamp_s, position_rad=self.q,
            base_from_tool=FRAMES.tool(self.q, self.flange_from_grip), wrench=np.zeros(6),
            peak_force_n=float(forces.max(initial=0.0)), gripper_width_m=0.0, log=log,
        )  # fmt: skip

    def _follow(self, motion: CartesianPath) -> tuple[Array, Array, str | None]:
        here = FRAMES.tool(self.q, self.flange_from_grip)
        goal = motion.base_from_tool[-1]
        tips, forces, tripped = [], [], None
        for share in np.linspace(0.0, 1.0, SAMPLES):
            tip = interpolate(here, goal, float(share)).translation
            force = self._force_n(tip)
            self._switch(tip)
            tips.append(tip)
            forces.append(force)
            for guard in motion.guards:
                if (
                    guard.quantity is Quantity.FORCE
                    and guard.axis is not None
                    and -guard.axis[2] * force >= guard.limit
                ):
                    tripped = guard.name
            if tripped is not None:
                break
        flange = RigidTransform.from_components(tips[-1], goal.rotation) * self.flange_from_grip.inv()
        branches = FRAMES.inverse(flange)
        self.q = branches[int(np.argmin([np.abs(q - self.q).max() for q in branches]))]
        return np.array(tips), np.array(forces), tripped

    def _over_cap(self, tip: Array) -> tuple[bool, float]:
        x, y, z = self.base_from_panel.inv().apply(tip)
        px, py = self.cap.position_m
        return not self.is_gone and np.hypot(x - px, y - py) < self.cap.radius_m, float(z)

    def _force_n(self, tip: Array) -> float:
        is_over, z = self._over_cap(tip)
        if not is_over:
            return STIFF_N_PER_M * max(0.0, -z)
        cap = self.cap
        rest_m = LATCHED_SHARE * cap.travel_m if self.is_latched else 0.0
        depth = cap.height_m - z
        if depth <= rest_m:
            return 0.0
        stop_m = min(self.stuck_at_m, cap.travel_m)
        spring = cap.preload_n + cap.spring_n_per_m * (min(depth, stop_m) - rest_m)
        return float(min(spring, STIFF_N_PER_M * (depth - rest_m)) + STIFF_N_PER_M * max(0.0, depth - stop_m))

    def _switch(self, tip: Array) -> None:
        is_over, z = self._over_cap(tip)
        depth = min(self.cap.height_m - z, self.stuck_at_m) if is_over else 0.0
        if not self.is_in and depth >= 0.8 * self.cap.travel_m:
            self.is_in = True
            self.presses += 1
            self.is_latched = self.latches and (not self.is_latched or not self.releases)
        elif self.is_in and depth <= 0.7 * self.cap.travel_m:
            self.is_in = False


def raised(pose: RigidTransform, height_m: float) -> RigidTransform:
    """Return a panel pose whose plate is `height_m` higher."""
    return pose * RigidTransform.from_translation([0.0, 0.0, height_m])
