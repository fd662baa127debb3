"""Each compiled loop has one set of argument types, and all are compiled before a user waits for them."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from perception.range import analyse, fit_plane_near, load_models, match_models, warm_up
from perception.range.window import Window
from tests.perception.range.scenes import PARALLEL, PINHOLE, ball_on_table, noisy


def signatures() -> dict[str, int]:
    """Return for how many sets of argument types each compiled loop of the package is loaded, by name."""
    modules = [module for name, module in sys.modules.items() if name.startswith("perception.range.")]
    loops = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {f"{loop.py_func.__module__}.{loop.py_func.__name__}": len(loop.signatures) for loop in loops}


@pytest.fixture(scope="module")
def warm() -> dict[str, int]:
    """Return what is loaded after warming up."""
    warm_up()
    return signatures()


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
@pytest.mark.parametrize("is_coded", [False, True], ids=["depth", "codes"])
def test_each_loop_has_one_signature_whatever_the_sensor_and_whether_depth_was_coded(warm, sensor, is_coded):
    assert any(warm.values())
    depth = noisy(ball_on_table(sensor).depth_m, 0.0003, seed=2, gross=0.005)
    if is_coded:
        window = Window(near_m=float(depth.min()), far_m=float(depth.max()))
        codes = np.rint((depth - window.near_m) / window.step_m).astype(np.uint8)
        depth = window.decode(codes)
    scene = analyse(depth.astype(np.float32) if not is_coded else depth, sensor)
    match_models(scene, depth, load_models()[:2])
    fit_plane_near(depth, sensor, point_m=[0.0, 0.0, 0.62], normal=[0.0, -0.5, -0.85], sigma_angle_rad=0.1)
    twice = {name: count for name, count in signatures().items() if count > 1}
    assert not twice
