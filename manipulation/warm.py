"""Compiles the kernels of control and planning, or loads them from the cache, so that the first plan is not slower."""

from __future__ import annotations

import numpy as np

from manipulation.arm import branches
from manipulation.arm import kernels as arm_kernels
from manipulation.control import braking, kernels
from manipulation.planning import clearance, rrt, timing_kernels


def warm_up() -> None:
    """Run every compiled function of kinematics, control, clearance and timing once, on an arm of six joints and one box."""
    dh, q = np.zeros((6, 4)), np.full(6, 0.1)
    dh[:, 1] = 0.2
    kernels.warm(dh)
    braking.warm(dh)
    arm_kernels.tool_and_jacobian(dh, q, np.eye(4))
    arm_kernels.rotation_log(np.eye(3))
    branches.warm(dh)
    timing_kernels.warm(dh)
    tool_ends, radii = np.zeros((1, 2, 3)), np.full(7, 0.01)
    box = (np.eye(3)[None], np.full((1, 3), 2.0), np.full((1, 3), 0.1))
    watched, pairs = np.ones((7, 1), bool), np.array([[0, 3]])
    clearance.least_clearance(dh, q, tool_ends, radii, *box, watched, pairs, 0.01, 0.01)
    clearance.first_hit(dh, q, q + 0.1, 0.05, tool_ends, radii, *box, watched, pairs, 0.01)
    roots, weights = np.array([q, q + 0.1]), np.ones(6)
    rrt.grown(roots, roots, weights, 0.05, dh, tool_ends, radii, *box, watched, pairs, 0.01)
    clearance.all_clear(dh, q[None], tool_ends, radii, *box, watched, pairs, 0.01)
    clearance.overlap_counts(dh, q[None], tool_ends, radii, pairs)
    ends = clearance.capsule_ends(dh, q, tool_ends)
    clearance.segment_box(ends[0, 0], ends[0, 1], box[0][0], box[1][0], box[2][0])
    clearance.segment_segment(ends[0, 0], ends[0, 1], ends[3, 0], ends[3, 1])
