# ruff: noqa: E501  (one object a line reads best)
"""Panel with one object of every kind, and the states that it shows in the tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from benchmarks.vision_disturbance import Disturbance
from benchmarks.vision_drawing import Shown, camera, draw_panel, looking_at
from hal.calibration import CameraIntrinsics
from hal.geometry import UncertainPose, perturbed
from hal.panel import Panel
from hal.strict import parse_toml
from perception.vision.projection import CameraProjection

TOML = """
schema = 1
name = "test"
width_m = 0.60
height_m = 0.40
lights = [
  { name = "l0", position_m = [-0.285, 0.185, 0.0] }, { name = "l1", position_m = [0.285, 0.185, 0.0] },
  { name = "l2", position_m = [0.285, -0.185, 0.0] }, { name = "l3", position_m = [-0.285, -0.185, 0.0] },
]
objects = [
  { kind = "gauge", name = "pressure", position_m = [-0.21, 0.11], radius_m = 0.042, scale = { minimum = 0.0, maximum = 10.0, unit = "bar", at_min = -2.356, at_max = 2.356, major_ticks = 11 } },
  { kind = "panel_meter", name = "volts", position_m = [-0.08, 0.11], width_m = 0.10, height_m = 0.075, pivot_below_m = 0.028, needle_m = 0.045, scale = { minimum = 0.0, maximum = 5.0, unit = "V", at_min = -0.785, at_max = 0.785 } },
  { kind = "display", name = "flow", position_m = [0.07, 0.12], width_m = 0.09, height_m = 0.036, digits = 4, decimals = 1 },
  { kind = "display", name = "level", position_m = [0.20, 0.12], width_m = 0.09, height_m = 0.036, digits = 3, decimals = 0, style = "lcd" },
  { kind = "lamp", name = "ready", position_m = [-0.25, 0.01], radius_m = 0.010 },
  { kind = "button", name = "start", position_m = [-0.19, 0.01], radius_m = 0.012 },
  { kind = "toggle", name = "power", position_m = [-0.12, 0.0] },
  { kind = "rotary", name = "mode", position_m = [-0.03, -0.01], radius_m = 0.022, states = [ { name = "off", angle_rad = -0.8 }, { name = "low", angle_rad = 0.0 }, { name = "high", angle_rad = 0.8 } ] },
  { kind = "slider", name = "speed", position_m = [0.13, 0.02], travel_m = 0.08, scale = { minimum = 0.0, maximum = 100.0, unit = "%", at_min = -0.04, at_max = 0.04 } },
  { kind = "lever", name = "inlet", position_m = [-0.20, -0.12], states = [ { name = "closed", angle_rad = 0.0 }, { name = "open", angle_rad = 1.5708 } ] },
  { kind = "handwheel", name = "drain", position_m = [0.02, -0.12] },
  { kind = "mushroom", name = "emergency", position_m = [0.21, -0.10] },
]
"""

SHOWN: dict[str, Shown] = {
    "pressure": 6.3,
    "volts": 1.4,
    "flow": "47.3",
    "level": "-86",
    "ready": "on",
    "start": "released",
    "power": "off",
    "mode": "high",
    "speed": 30.0,
    "inlet": "open",
    "drain": 0.6,
    "emergency": "released",
}


def panel() -> Panel:
    """Return the test panel."""
    text = TOML.replace('style = "lcd" }', 'style = "lcd", minimum = -99.0 }')
    return parse_toml(text, Panel, source="test")


def scene(
    *,
    tilt_deg: float = 8.0,
    azimuth_deg: float = 30.0,
    distance_m: float = 0.62,
    shown: dict[str, Shown] | None = None,
    disturbance: Disturbance | None = None,
    pose_error: float = 1.0,
    seed: int = 1,
    size: tuple[int, int] = (1280, 960),
) -> tuple[NDArray[np.uint8], CameraIntrinsics, UncertainPose]:
    """Return image, intrinsics and a pose that is wrong by about one sigma of its covariance (one or two pixels)."""
    intrinsics = camera(*size, focal_px=float(size[0]))
    truth = RigidTransform.from_matrix(
        looking_at(distance_m=distance_m, tilt_rad=np.deg2rad(tilt_deg), azimuth_rad=np.deg2rad(azimuth_deg))
    )
    sigma = np.array([5e-4, 5e-4, 1e-3, 1.5e-3, 1.5e-3, 1.5e-3])
    covariance = np.diag(sigma**2)
    view = CameraProjection(
        intrinsics=intrinsics, camera_from_panel=UncertainPose(parent_from_child=truth, covariance=covariance)
    )
    image = draw_panel(panel(), view, (size[1], size[0]), {**SHOWN, **(shown or {})}, disturbance)
    delta = pose_error * sigma * np.random.default_rng(seed).standard_normal(6)
    return image, intrinsics, UncertainPose(parent_from_child=perturbed(truth, delta), covariance=covariance)
