"""Compilation of all range kernels in advance, so that no later call waits for the compiler."""

from __future__ import annotations

import numpy as np

from perception.range.analysis import analyse
from perception.range.matching.match import match_models
from perception.range.matching.models import load_models
from perception.range.plane import fit_plane_near
from perception.range.sensor import OrthographicSensor, PinholeSensor, RangeSensorModel

SIDE_PX = 200  # large enough that the coarse and the fine grid both run


def warm_up() -> None:
    """Analyse small synthetic scenes so that every kernel is compiled.

    Compiled code is cached on disk, so other processes need not compile again.
    """
    pinhole = PinholeSensor(width_px=SIDE_PX, height_px=SIDE_PX, fx_px=200.0, fy_px=200.0, cx_px=99.5, cy_px=99.5)
    parallel = OrthographicSensor(width_px=SIDE_PX, height_px=SIDE_PX, pixel_pitch_m=0.001)
    v, u = np.mgrid[:SIDE_PX, :SIDE_PX] * 0.001
    bump = np.sqrt(np.maximum(0.03**2 - (u - 0.05) ** 2 - (v - 0.1) ** 2, 0.0))
    ridge = np.sqrt(np.maximum(0.02**2 - (u - 0.15) ** 2, 0.0))
    small = np.where(np.hypot(u - 0.1, v - 0.03) < 0.006, 0.01, 0.0)
    noise = np.random.default_rng(0).normal(0.0, 0.0003, u.shape)
    groove = np.where(abs(v - 0.1) < 0.002, 0.005, 0.0)
    depth = 0.6 + 0.1 * v - np.maximum(np.maximum(bump, ridge), small) + groove + noise
    sensors: tuple[RangeSensorModel, ...] = (pinhole, parallel)
    for sensor in sensors:
        scene = analyse(depth, sensor)
        match_models(scene, depth, load_models()[:1])
    analyse(depth + 10.0 * noise, pinhole)  # so noisy that larger blocks are used
    fit_plane_near(depth, pinhole, point_m=[0.0, 0.0, 0.61], normal=[0.0, 0.0, -1.0])
