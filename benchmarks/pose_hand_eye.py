"""Hand-eye calibration in simulation: from the pixels of the panel's lights at twelve arm poses to the mount."""

from __future__ import annotations

import numpy as np

from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.geometry import difference, perturbed, transform_rpy
from perception.calibration import Beforehand, InHandState, InHandView, calibrate_in_hand
from perception.calibration.calibration_poses import stations

LIGHTS = np.array([[-0.28, 0.2, 0.0], [0.28, 0.2, 0.0], [0.28, -0.2, 0.0], [-0.28, -0.2, 0.0]])
LENS = CameraIntrinsics(
    width_px=1280, height_px=960, fx_px=900.0, fy_px=900.0, cx_px=640.0, cy_px=480.0,
    distortion=(-0.1, 0.03, 0.0005, -0.0005, 0.0),
)  # fmt: skip
PIXEL_SIGMA = 0.15
ARM_SIGMA = 1e-4  # m and rad
# Lens and lights are known exactly.
KNOWN = Beforehand(
    focal_ratio=1e-7, centre_px=1e-4, k1=1e-7, point_m=1e-8, arm_m=ARM_SIGMA, arm_rad=ARM_SIGMA, offset=(1e-6, 1e-6)
)
ROUGH = np.repeat([0.01, 0.05], 3)  # errors of the drawing of mount and panel, m and rad


def trial(seed: int) -> tuple[float, float]:
    """Return the errors of flange_from_camera in mm and degrees, for a random mount and panel."""
    rng = np.random.default_rng(seed)
    x = transform_rpy(rng.uniform(-0.08, 0.08, 3), rng.uniform(-0.3, 0.3, 3) + np.array([0.0, 0.0, np.pi / 2]))
    z = transform_rpy([0.9, rng.uniform(-0.1, 0.1), 0.5], [0.0, -np.pi / 2, rng.uniform(-0.3, 0.3)])
    views = []
    for flange in stations(z, x, distance_m=0.75, count=12):
        real = perturbed(flange, rng.normal(scale=ARM_SIGMA, size=6))
        camera_from_panel = (real * x).inv() * z
        pixels = project(camera_from_panel.apply(LIGHTS), LENS) + rng.normal(scale=PIXEL_SIGMA, size=(4, 2))
        covariance = np.tile(PIXEL_SIGMA**2 * np.eye(2), (4, 1, 1))
        views.append(InHandView(base_from_flange=flange, pixels_px=pixels, covariance_px=covariance))
    start = InHandState(
        flange_from_camera=perturbed(x, rng.normal(scale=ROUGH)), base_from_target=perturbed(z, rng.normal(scale=ROUGH)),
        intrinsics=LENS, point_errors_m=np.zeros((4, 3)),
    )  # fmt: skip
    found = calibrate_in_hand(views, LIGHTS, start, KNOWN)
    e = difference(x, found.flange_from_camera.parent_from_child)
    return float(1e3 * np.linalg.norm(e[:3])), float(np.degrees(np.linalg.norm(e[3:])))


def rows(count: int) -> list[tuple[str, str, str]]:
    """Return the table rows over `count` random cells."""
    errors = np.array([trial(seed) for seed in range(count)])
    middle, worst = np.median(errors, axis=0), errors.max(axis=0)
    figures = f"median {middle[0]:.2f} mm, {middle[1]:.3f} deg; worst of {count}: {worst[0]:.2f} mm, {worst[1]:.3f} deg"
    return [("hand-eye in simulation, 12 poses", "<= 1 mm, 0.2 deg", figures)]
