"""The hot loops are compiled before a user waits for them."""

from __future__ import annotations

import sys

import numpy as np
from numba.core.dispatcher import Dispatcher

from fusion import fuse, fuse_observations, warm_up
from hal.geometry import UncertainPose
from tests.fusion.mixtures import mixture
from tests.fusion.test_shared_errors import MOUNTS, draw


def variants() -> dict[str, int]:
    """Return how often each compiled loop of the package was compiled or loaded, by name."""
    modules = [module for name, module in sys.modules.items() if name.startswith("fusion.")]
    loops = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {f"{loop.py_func.__module__}.{loop.py_func.__name__}": len(loop.signatures) for loop in loops}


def test_after_warming_up_no_fusion_waits_for_a_compiler() -> None:
    p = mixture(16, 3, bad=4)  # made before, because users do not make simulated problems
    warm_up()
    warm = variants()
    assert any(warm.values())
    prior = UncertainPose(parent_from_child=p.base_from_object, covariance=1e-4 * np.eye(6))
    fuse(p.measurements)
    fuse(p.measurements, prior=prior, certify=True)
    fuse([min(p.measurements, key=lambda one: one.dof)], prior=prior)
    fuse_observations(draw(np.random.default_rng(1)), MOUNTS)
    assert variants() == warm
    assert max(warm.values()) == 1, "another set of argument types would be compiled as a kernel of its own"
