"""The arm's kinematics from its capabilities: forward, Jacobian, and every branch of the inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from eaik.IK_DH import DhRobot
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.devices import ArmCapabilities
from hal.errors import Unreachable
from manipulation import kernels

Array = NDArray[np.float64]

RESIDUAL = 1e-6  # EAIK answers an unreachable pose in the least-squares sense; a round trip through FK tells
LARGEST_STEP_RAD = 0.35  # between neighbouring samples of a stroke; a larger step is another branch
SINGULAR_RATIO = 0.02  # smallest singular value of the scaled Jacobian; the notes' strokes fail below


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
        """Build from what the arm says about itself."""
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
        """`base_from_flange` for joints (n,) rad."""
        return RigidTransform.from_matrix(kernels.frames(self.dh, q_rad)[-1])

    def tool(self, q_rad: Array, flange_from_tool: RigidTransform) -> RigidTransform:
        """`base_from_tool` for joints (n,) rad."""
        return self.flange(q_rad) * flange_from_tool

    def jacobian(self, q_rad: Array, flange_from_tool: RigidTransform) -> Array:
        """(6, n) Jacobian of the tool's origin in base axes: velocity, then angular velocity."""
        matrix = np.ascontiguousarray(flange_from_tool.as_matrix())
        return np.asarray(kernels.tool_and_jacobian(self.dh, q_rad, matrix)[1])

    def inverse(self, base_from_flange: RigidTransform) -> Array:
        """All joint vectors (k, n) rad inside the limits that reach the pose; whole turns count as branches of their
        own.

        Source: Elsner et al., EAIK, 2025 (subproblem decomposition); each answer is checked by forward kinematics.
        """
        goal = base_from_flange.as_matrix()
        found = np.atleast_2d(np.asarray(self.solver.IK(goal).Q, float))
        if found.size == 0:
            return np.empty((0, len(self.dh)))
        found = found[np.all(np.isfinite(found), axis=1)] - self.dh[:, 3]
        good = [q for q in found if np.abs(kernels.frames(self.dh, q)[-1] - goal).max() < RESIDUAL]
        turned = [wrapped for q in good for wrapped in self._within_limits(q)]
        return np.array(turned).reshape(-1, len(self.dh))

    def follow(
        self, base_from_flange: Sequence[RigidTransform], *, near_rad: Array, start_rad: Array | None = None
    ) -> tuple[Array, ...]:
        """Joint paths (N, n), one for each branch that follows *all* poses without a jump, limit or singularity;
        best first.

        The branch is chosen over the whole stroke: one lever arc in five met a wrist limit when chosen by its first
        pose.

        Args:
            near_rad: branches are ranked by how far the arm must move from here.
            start_rad: only branches that begin within 0.35 rad of these joints.

        Raises:
            Unreachable: no branch does; says which pose stops the longest one.
        """
        candidates = [self.inverse(pose) for pose in base_from_flange]
        starts = candidates[0] if start_rad is None else _near(candidates[0], start_rad)
        paths, furthest = [], 0
        for q in starts:
            path, reached = self._follow_branch(q, candidates)
            furthest = max(furthest, reached)
            if path is not None:
                paths.append(path)
        if not paths:
            where = base_from_flange[furthest].translation
            raise Unreachable(
                f"no arm configuration follows the path beyond pose {furthest + 1} of {len(base_from_flange)} at "
                f"({where[0]:.3f}, {where[1]:.3f}, {where[2]:.3f}) m",
                hint="move the panel nearer to the middle of the arm's workspace, or turn the tool about its axis",
            )
        return tuple(sorted(paths, key=lambda path: self._effort(path, near_rad)))

    def _follow_branch(self, start: Array, candidates: Sequence[Array]) -> tuple[Array | None, int]:
        path = [start]
        for k, options in enumerate(candidates[1:], start=1):
            close = _near(options, path[-1])
            if len(close) == 0:
                return None, k
            path.append(close[0])
        if min(self.conditioning(q) for q in path[:: max(1, len(path) // 8)]) < SINGULAR_RATIO:
            return None, len(path) - 1
        return np.array(path), len(path) - 1

    def conditioning(self, q_rad: Array) -> float:
        """Smallest singular value of the flange Jacobian with lengths scaled by 0.5 m; 0 at a singularity."""
        scale = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])[:, None]
        _, jacobian = kernels.tool_and_jacobian(self.dh, q_rad, np.eye(4))
        return float(np.linalg.svd(scale * jacobian, compute_uv=False)[-1])

    def _effort(self, path: Array, near_rad: Array) -> float:
        # Seconds to get there, plus a price for ending near a limit or a singularity.
        travel = np.max(np.abs(path[0] - near_rad) / self.velocity_rad_per_s)
        margin = np.min(np.minimum(path - self.lower_rad, self.upper_rad - path))
        poor = min(self.conditioning(path[0]), self.conditioning(path[-1]))
        return float(travel + 0.05 / (margin + 0.02) + 0.05 / (poor + 0.02))

    def _within_limits(self, q: Array) -> list[Array]:
        """All vectors equal to `q` up to whole turns of single joints and inside the limits."""
        choices = []
        for angle, low, high in zip(q, self.lower_rad, self.upper_rad, strict=True):
            first = angle + 2.0 * np.pi * np.ceil((low - angle) / (2.0 * np.pi) - 1e-12)
            choices.append(np.arange(first, high + 1e-12, 2.0 * np.pi))
        return [np.array(c) for c in np.stack(np.meshgrid(*choices, indexing="ij"), axis=-1).reshape(-1, len(q))]


def _near(options: Array, q: Array) -> Array:
    """Rows of `options` within one step of `q`, nearest first."""
    if len(options) == 0:
        return options
    distance = np.max(np.abs(options - q), axis=1)
    order = np.argsort(distance)
    return np.asarray(options[order][distance[order] <= LARGEST_STEP_RAD])
