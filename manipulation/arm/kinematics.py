"""The arm's kinematics from its capabilities: forward, Jacobian, and every branch of the inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from eaik.IK_DH import DhRobot
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import ArmCapabilities
from hal.errors import ConfigError, Unreachable
from hal.geometry import orthonormal, product
from manipulation.arm import branches, kernels
from manipulation.arm.branches import whole_turns

LARGEST_STEP_RAD = 0.35  # between neighbouring samples of a stroke; a larger step is another branch
SOLVED_JOINTS = 6  # the solver takes a chain of six; the joints beyond it are free to choose
FREE_JOINT_SAMPLES = 16  # values of a free joint that are tried
MOST_STARTS = 40  # of a stroke, nearest first; an arm of six joints has at most 16
RISE_S = 0.03  # time in which a joint may change its acceleration from 0 to the limit
SINGULAR_RATIO = 0.02  # smallest singular value of the scaled Jacobian; strokes fail below this
BY_LENGTH = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])[:, None]  # scales lengths by 0.5 m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kinematics:
    """Forward and inverse kinematics of an arm of six joints, or of seven, the last of which is a turn of the wrist.

    A joint vector of seven is one of six for a flange that is turned back by the seventh joint. The seventh is sampled.

    Attributes:
        dh: (n, 4) rows (d, a, alpha, offset), m and rad.
        lower_rad, upper_rad, velocity_rad_per_s, acceleration_rad_per_s2, jerk_rad_per_s3: (n,) limits.
        solver: the EAIK robot of the first six joints.
    """

    capabilities: ArmCapabilities
    dh: Array
    lower_rad: Array
    upper_rad: Array
    velocity_rad_per_s: Array
    acceleration_rad_per_s2: Array
    jerk_rad_per_s3: Array
    solver: Any

    @classmethod
    def of(cls, capabilities: ArmCapabilities, joint_limits_rad: Sequence[tuple[float, float]] = ()) -> Kinematics:
        """Build the kinematics from the arm's capabilities.

        Args:
            joint_limits_rad: least and largest angle of each joint, which narrow the arm's own range; empty for that range.

        Raises:
            ConfigError: the arm has other than six or seven joints, or other than those in `joint_limits_rad`.
        """
        own = list(zip(capabilities.lower_rad, capabilities.upper_rad, strict=True))
        narrow = list(joint_limits_rad) or own
        if len(narrow) != len(own) or any(max(a[0], b[0]) >= min(a[1], b[1]) for a, b in zip(own, narrow, strict=True)):
            raise ConfigError(
                f"safety.joint_limits_rad does not fit {capabilities.model!r} with its {len(own)} joints",
                hint=f"give each joint a least and a larger angle within {own}",
                key="safety.joint_limits_rad",
            )
        dh = np.array([[link.d_m, link.a_m, link.alpha_rad, link.offset_rad] for link in capabilities.links])
        solver = DhRobot(dh[:SOLVED_JOINTS, 2], dh[:SOLVED_JOINTS, 1], dh[:SOLVED_JOINTS, 0])
        if len(dh) not in (SOLVED_JOINTS, SOLVED_JOINTS + 1):
            raise _unsolved(capabilities)
        return cls(
            capabilities=capabilities,
            dh=dh,
            lower_rad=np.array([max(a[0], b[0]) for a, b in zip(own, narrow, strict=True)]),
            upper_rad=np.array([min(a[1], b[1]) for a, b in zip(own, narrow, strict=True)]),
            velocity_rad_per_s=np.array(capabilities.velocity_rad_per_s),
            acceleration_rad_per_s2=np.array(capabilities.acceleration_rad_per_s2),
            jerk_rad_per_s3=np.array(capabilities.acceleration_rad_per_s2) / RISE_S,
            solver=solver,
        )

    def flange(self, q_rad: Array) -> RigidTransform:
        """Return `base_from_flange` for joints (n,) rad."""
        return orthonormal(kernels.frames(self.dh, q_rad)[-1])

    def tool(self, q_rad: Array, flange_from_tool: RigidTransform) -> RigidTransform:
        """Return `base_from_tool` for joints (n,) rad."""
        return product(self.flange(q_rad), flange_from_tool)

    def jacobian(self, q_rad: Array, flange_from_tool: RigidTransform) -> Array:
        """Return the (6, n) Jacobian of the tool's origin in base axes: velocity, then angular velocity."""
        matrix = np.ascontiguousarray(flange_from_tool.as_matrix())
        return np.asarray(kernels.tool_and_jacobian(self.dh, q_rad, matrix)[1])

    def inverse(self, base_from_flange: RigidTransform) -> Array:
        """Return all joint vectors (k, n) rad inside the limits that reach the pose, with all whole turns of joints.

        Source: Elsner et al., EAIK, 2025 (subproblem decomposition); each solution is checked by forward kinematics.
        """
        solved = self._branches(base_from_flange.as_matrix(), self._free_joint())
        found: Array = branches.all_turns(solved, self.lower_rad, self.upper_rad)
        return found

    def _free_joint(self, *values: float) -> Array:
        """Return the values of the free joint to try: samples of its range, and those given."""
        if len(self.dh) == SOLVED_JOINTS:
            return np.empty(0)
        return np.concatenate([np.linspace(self.lower_rad[-1], self.upper_rad[-1], FREE_JOINT_SAMPLES), values])

    def _branches(self, goal: Array, free_rad: Array) -> Array:
        """Return the joint vectors (k, n) that reach the pose (4, 4), each joint up to whole turns."""
        if len(self.dh) == SOLVED_JOINTS:
            return self._solved(goal)
        some = []
        for free in free_rad:
            turn_back = np.linalg.inv(kernels.frames(self.dh[SOLVED_JOINTS:], np.array([free]))[-1])
            six = self._solved(goal @ turn_back)
            some.append(np.column_stack([six, np.full(len(six), free)]))
        return np.concatenate(some)

    def _solved(self, goal: Array) -> Array:
        """Return the branches (k, 6) of the first six joints for the pose (4, 4) of the frame after them."""
        if not self.solver.hasKnownDecomposition():  # only here: without it, such an arm still moves by its joints
            raise _unsolved(self.capabilities)
        dh = self.dh[:SOLVED_JOINTS]
        found = np.ascontiguousarray(self.solver.IK(goal).Q, float).reshape(-1, SOLVED_JOINTS)
        exact: Array = branches.exact_branches(dh, found - dh[:, 3], np.ascontiguousarray(goal))
        return exact

    def follow(self, base_from_flange: Sequence[RigidTransform], *, near_rad: Array) -> tuple[Array, ...]:
        """Return the joint paths (N, n) that follow *all* poses without a jump, limit or singularity; best first.

        The branch is chosen over the whole stroke: chosen by the first pose alone, one lever arc in five meets a wrist
        limit. Paths that differ by whole turns of single joints are all returned, but their branch is followed only
        once.

        Args:
            near_rad: paths are ranked by how far the arm must move from these joints.

        Raises:
            Unreachable: no branch follows all poses; names the pose at which the longest one stops.
        """
        poses = np.array([pose.as_matrix() for pose in base_from_flange])
        ranked: list[tuple[float, Array]] = []
        furthest = 0
        for q in self._starts(poses[0], near_rad):
            path = branches.followed(self.dh, q, poses, LARGEST_STEP_RAD)
            within = int(np.count_nonzero(_fits(path, self.lower_rad, self.upper_rad)))
            furthest = max(furthest, min(within, len(poses) - 1))
            if within == len(poses) and self._is_regular(path):
                poor = min(self.conditioning(path[0]), self.conditioning(path[-1]))
                turns = whole_turns(path.min(axis=0), path.max(axis=0), self.lower_rad, self.upper_rad)
                ranked += [(self._effort(path + turn, near_rad, poor), path + turn) for turn in turns]
        if not ranked:
            where = base_from_flange[furthest].translation
            raise Unreachable(
                f"no arm configuration follows the path beyond pose {furthest + 1} of {len(base_from_flange)} at "
                f"({where[0]:.3f}, {where[1]:.3f}, {where[2]:.3f}) m",
                hint="move the panel nearer to the middle of the arm's workspace, or turn the tool about its axis",
            )
        return tuple(path for _, path in sorted(ranked, key=lambda pair: pair[0]))

    def _starts(self, pose: Array, near_rad: Array) -> Array:
        """Return the branches (k, n) of a stroke's first pose that can be inside the limits, nearest first."""
        found = self._branches(pose, self._free_joint(near_rad[-1]))
        found = found[[bool(_fits(q[None], self.lower_rad, self.upper_rad)[0]) for q in found]]
        if len(found) <= MOST_STARTS:
            return found
        travel = np.abs((found - near_rad + np.pi) % branches.TURN_RAD - np.pi) / self.velocity_rad_per_s
        return np.asarray(found[np.argsort(travel.max(axis=1), kind="stable")[:MOST_STARTS]])

    def _is_regular(self, path: Array) -> bool:
        return min(self.conditioning(q) for q in path[:: max(1, len(path) // 8)]) >= SINGULAR_RATIO

    def conditioning(self, q_rad: Array) -> float:
        """Return the smallest singular value of the flange Jacobian, lengths scaled by 0.5 m; 0 at a singularity."""
        _, jacobian = kernels.tool_and_jacobian(self.dh, q_rad, np.eye(4))
        return float(np.linalg.svd(BY_LENGTH * jacobian, compute_uv=False)[-1])

    def follow_from(self, q_rad: Array, base_from_flange: Sequence[RigidTransform]) -> Array | None:
        """Return the joints (N, n) that follow poses from joints (n,); None beyond limits, jumps or singularities."""
        poses = np.array([pose.as_matrix() for pose in base_from_flange])
        path: Array = branches.followed(self.dh, np.ascontiguousarray(q_rad), poses, LARGEST_STEP_RAD)
        is_inside = len(path) == len(poses) and bool(np.all((path >= self.lower_rad) & (path <= self.upper_rad)))
        return path if is_inside and self._is_regular(path) else None

    def effort_s(self, path: Array, near_rad: Array) -> float:
        """Return the time from joints (n,) to the begin of a path (N, n), longer where it nears limits or singularities."""
        return self._effort(path, near_rad, min(self.conditioning(path[0]), self.conditioning(path[-1])))

    def _effort(self, path: Array, near_rad: Array, poor: float) -> float:
        travel = np.max(np.abs(path[0] - near_rad) / self.velocity_rad_per_s)
        margin = np.min(np.minimum(path - self.lower_rad, self.upper_rad - path))
        return float(travel + 0.05 / (margin + 0.02) + 0.05 / (poor + 0.02))


def _fits(path: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Return (m,) for each point of a path whether whole turns can bring the path up to there inside the limits."""
    low, high = np.minimum.accumulate(path), np.maximum.accumulate(path)
    turns = branches.TURN_RAD * np.ceil((lower - low) / branches.TURN_RAD - 1e-12)
    return np.asarray((high + turns <= upper + 1e-12).all(axis=1))


def _unsolved(capabilities: ArmCapabilities) -> ConfigError:
    return ConfigError(
        f"arm {capabilities.model!r}: no closed inverse kinematics for its {len(capabilities.links)} joints",
        hint="use an arm of six joints with a known solution, or of seven whose first six have one",
    )
