"""Every compiled loop of vision is compiled for one set of argument types, whatever is read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
READ_EVERYTHING = """
import gc

import numpy as np
from numba.core.dispatcher import Dispatcher

from benchmarks.vision_manometers import draw_manometer
from perception.vision import find_panel, inspect, load_knowledge, read_photograph, recognise, warm_up
from perception.vision.warm import three_eights
from tests.perception.vision.bench_panel import panel, scene
from tests.perception.vision.lights.test_lights import CAMERA, LIGHTS, pair

warm_up()
image, intrinsics, pose = scene(tilt_deg=5.0, distance_m=0.6)
for picture in (image, np.ascontiguousarray(image[..., 0]) if image.ndim == 3 else np.dstack([image] * 3)):
    picture.flags.writeable = False  # as Pillow gives them
    inspect(picture, intrinsics, pose, panel())
    recognise(picture, load_knowledge())
find_panel(*pair(), LIGHTS, CAMERA)
read_photograph(draw_manometer(5).image, "gauge", scale=(0.0, 1.0))
read_photograph(three_eights(), "display", is_scene=True)
kernels = [o for o in gc.get_objects() if isinstance(o, Dispatcher) and o.py_func.__module__.startswith("perception.vision")]
print(sum(bool(kernel.signatures) for kernel in kernels))
for kernel in kernels:
    if len(kernel.signatures) > 1:
        print(kernel.py_func.__module__, kernel.py_func.__name__, kernel.signatures)
"""


def test_each_loop_has_one_signature_after_all_kinds_of_readings() -> None:
    told = subprocess.run(
        [sys.executable, "-c", READ_EVERYTHING], cwd=ROOT, check=True, capture_output=True, text=True, timeout=280
    ).stdout.splitlines()
    assert int(told[0]) >= 20, "the loops were found"
    assert told[1:] == []
