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
from hal.errors import Unreachable
from manipulation.arm import kernels

RESIDUAL = 1e-6  # EAIK answers an unreachable pose by least squares; forward kinematics shows the difference
LARGEST_STEP_RAD = 0.35  # between neighbouring samples of a stroke; a larger step is another branch
TURN_RAD = 2.0 * np.pi
SINGULAR_RATIO = 0.02  # smallest singular value of the scaled Jacobian; strokes fail below this


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kinematics:
    """Forward and inverse kinematics of a six-joint arm.

    Attributes:
        dh: (n, 4) rows (d, a, alpha, offset), m and rad.
        lower_rad, upper_rad, velocity_rad_per_s, acceleration_rad_per_s2: (n,) limits.
        solver: the EAIK robot.
    """

    capabilities: ArmCapabilities
    dh: Array
    lower_rad: Array
    upper_rad: Array
    velocity_rad_per_s: Array
    acceleration_rad_per_s2: Array
    solver: Any

    @classmethod
    def of(cls, capabilities: ArmCapabilities) -> Kinematics:
        """Build the kinematics from the arm's capabilities."""
        dh = np.array([[link.d_m, link.a_m, link.alpha_rad, link.offset_rad] for link in capabilities.links])
        return cls(
            capabilities=capabilities,
            dh=dh,
            lower_rad=np.array(capabilities.lower_rad),
            upper_rad=np.array(capabilities.upper_rad),
            velocity_rad_per_s=np.array(capabilities.velocity_rad_per_s),
            acceleration_rad_per_s2=np.array(capabilities.acceleration_rad_per_s2),
            solver=DhRobot(dh[:, 2], dh[:, 1], dh[:, 0]),
        )

    def flange(self, q_rad: Array) -> RigidTransform:
        """Return `base_from_flange` for joints (n,) rad."""
        return RigidTransform.from_matrix(kernels.frames(self.dh, q_rad)[-1])

    def tool(self, q_rad: Array, flange_from_tool: RigidTransform) -> RigidTransform:
        """Return `base_from_tool` for joints (n,) rad."""
        return self.flange(q_rad) * flange_from_tool

    def jacobian(self, q_rad: Array, flange_from_tool: RigidTransform) -> Array:
        """Return the (6, n) Jacobian of the tool's origin in base axes: velocity, then angular velocity."""
        matrix = np.ascontiguousarray(flange_from_tool.as_matrix())
        return np.asarray(kernels.tool_and_jacobian(self.dh, q_rad, matrix)[1])

    def inverse(self, base_from_flange: RigidTransform) -> Array:
        """Return all joint vectors (k, n) rad inside the limits that reach the pose, with all whole turns of joints.

        Source: Elsner et al., EAIK, 2025 (subproblem decomposition); each solution is checked by forward kinematics.
        """
        turned = [_turned(q[None], self.lower_rad, self.upper_rad)[:, 0] for q in self._branches(base_from_flange)]
        return np.concatenate([np.empty((0, len(self.dh))), *turned])

    def _branches(self, base_from_flange: RigidTransform) -> Array:
        """Return the joint vectors (k, n) that reach the pose, each joint up to whole turns."""
        goal = base_from_flange.as_matrix()
        found = np.atleast_2d(np.asarray(self.solver.IK(goal).Q, float))
        if found.size == 0:
            return np.empty((0, len(self.dh)))
        found = found[np.all(np.isfinite(found), axis=1)] - self.dh[:, 3]
        return found[[np.abs(kernels.frames(self.dh, q)[-1] - goal).max() < RESIDUAL for q in found]]

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
        branches = [self._branches(pose) for pose in base_from_flange]
        ranked: list[tuple[float, Array]] = []
        furthest = 0
        for q in branches[0]:
            path = _unwound(q, branches[1:])
            within = int(np.count_nonzero(_fits(path, self.lower_rad, self.upper_rad)))
            furthest = max(furthest, min(within, len(branches) - 1))
            if within == len(branches) and self._is_regular(path):
                poor = min(self.conditioning(path[0]), self.conditioning(path[-1]))
                turned = _turned(path, self.lower_rad, self.upper_rad)
                ranked += [(self._effort(turn, near_rad, poor), turn) for turn in turned]
        if not ranked:
            where = base_from_flange[furthest].translation
            raise Unreachable(
                f"no arm configuration follows the path beyond pose {furthest + 1} of {len(base_from_flange)} at "
                f"({where[0]:.3f}, {where[1]:.3f}, {where[2]:.3f}) m",
                hint="move the panel nearer to the middle of the arm's workspace, or turn the tool about its axis",
            )
        return tuple(path for _, path in sorted(ranked, key=lambda pair: pair[0]))

    def _is_regular(self, path: Array) -> bool:
        return min(self.conditioning(q) for q in path[:: max(1, len(path) // 8)]) >= SINGULAR_RATIO

    def conditioning(self, q_rad: Array) -> float:
        """Return the smallest singular value of the flange Jacobian, lengths scaled by 0.5 m; 0 at a singularity."""
        scale = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])[:, None]
        _, jacobian = kernels.tool_and_jacobian(self.dh, q_rad, np.eye(4))
        return float(np.linalg.svd(scale * jacobian, compute_uv=False)[-1])

    def _effort(self, path: Array, near_rad: Array, poor: float) -> float:
        # Seconds to get there, plus a penalty for ending near a limit or a singularity.
        travel = np.max(np.abs(path[0] - near_rad) / self.velocity_rad_per_s)
        margin = np.min(np.minimum(path - self.lower_rad, self.upper_rad - path))
        return float(travel + 0.05 / (margin + 0.02) + 0.05 / (poor + 0.02))


def _unwound(start: Array, branches: Sequence[Array]) -> Array:
    """Return the path (m, n) from `start` through the nearest solution of each pose, up to the first jump."""
    path = [start]
    for options in branches:
        steps = (options - path[-1] + np.pi) % TURN_RAD - np.pi
        lengths = np.abs(steps).max(axis=1, initial=0.0)
        if len(steps) == 0 or lengths.min() > LARGEST_STEP_RAD:
            break
        path.append(path[-1] + steps[np.argmin(lengths)])
    return np.array(path)


def _fits(path: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Return (m,) for each point of a path whether whole turns can bring the path up to there inside the limits."""
    low, high = np.minimum.accumulate(path), np.maximum.accumulate(path)
    return np.asarray((high + _least_turns(low, lower) <= upper + 1e-12).all(axis=1))


def _turned(path: Array, lower: Array, upper: Array) -> Array:
    """Return all paths (k, m, n) inside the limits that equal this one (m, n) up to whole turns of single joints."""
    first = _least_turns(path.min(axis=0), lower)
    choices = [
        np.arange(least, limit - highest + 1e-12, TURN_RAD)
        for least, highest, limit in zip(first, path.max(axis=0), upper, strict=True)
    ]
    turns = np.stack(np.meshgrid(*choices, indexing="ij"), axis=-1).reshape(-1, 1, path.shape[1])
    return np.asarray(path + turns)


def _least_turns(lowest: Array, lower: Array) -> Array:
    return np.asarray(TURN_RAD * np.ceil((lower - lowest) / TURN_RAD - 1e-12))
