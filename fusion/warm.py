"""Compile or load the fast loops before the first caller waits for them."""

from __future__ import annotations

import numpy as np

from fusion.certify.dual import minimiser
from fusion.certify.proof import quadratic_forms
from fusion.robust import fuse, used_entries
from fusion.simulate import CODES, problem
from fusion.solve import solve
from hal.geometry import UncertainPose


def warm_up() -> None:
    """Run one small problem of every class. Minutes after a change of the code, milliseconds when the cache is there."""
    made = problem(CODES, np.random.default_rng(0))
    solve(made.measurements, made.base_from_object)
    prior = UncertainPose(parent_from_child=made.base_from_object, covariance=1e-4 * np.eye(6))
    fuse(made.measurements, prior=prior)
    fuse([min(made.measurements, key=lambda one: one.dof)], prior=prior)  # where many poses fit, all are looked for
    b, _, local = used_entries(made.measurements, fuse(made.measurements))
    forms = quadratic_forms(b, local.rotation, local.translation_m, np.zeros(3), np.zeros(3), 1.0)
    minimiser(forms.sum(axis=0), local.rotation, local.translation_m)
