"""Compile or load the fast loops before the first caller waits for them."""

from __future__ import annotations

import numpy as np

from fusion.robust import fuse
from fusion.simulate import CODES, problem
from fusion.solve import solve
from hal.geometry import UncertainPose


def warm_up() -> None:
    """Run one small problem of every class. Minutes after a change of the code, milliseconds when the cache is there."""
    made = problem(CODES, np.random.default_rng(0))
    solve(made.measurements, made.base_from_object)
    fuse(made.measurements, prior=UncertainPose(parent_from_child=made.base_from_object, covariance=1e-4 * np.eye(6)))
    fuse(made.measurements)
