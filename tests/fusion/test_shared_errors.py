"""The stated covariance of fused observations is right if every error is drawn as stated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion import Observation, PixelObservation, ProximityObservation, TouchObservation, fuse_observations
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.geometry import UncertainPose, difference, perturbed, transform_rpy

LENS = CameraIntrinsics(
    width_px=640, height_px=480, fx_px=460.0, fy_px=460.0, cx_px=319.5, cy_px=239.5, distortion=(-0.08, 0.02, 0, 0, 0)
)
LIGHTS = {
    "nw": (-0.28, 0.20, 0.004),
    "ne": (0.28, 0.20, 0.004),
    "se": (0.28, -0.20, 0.004),
    "sw": (-0.28, -0.20, 0.004),
}
BASE_FROM_PANEL = transform_rpy((0.95, 0.03, 0.55), (1.55, 0.05, -1.52))
MOUNT_COVARIANCE = np.diag([2e-4, 2e-4, 2e-4, 9e-4, 9e-4, 9e-4]) ** 2
MOUNTS = {
    "camera": UncertainPose(
        parent_from_child=transform_rpy((0.0, -0.09, 0.06), (0.0, 0.0, 0.0)), covariance=MOUNT_COVARIANCE
    ),
    "grip": UncertainPose(
        parent_from_child=transform_rpy((0.0, 0.0, 0.21), (0.0, 0.0, 0.0)), covariance=MOUNT_COVARIANCE
    ),
    "beam": UncertainPose(
        parent_from_child=transform_rpy((0.02, 0.0, 0.18), (0.0, 0.0, 0.0)), covariance=MOUNT_COVARIANCE
    ),
}
PIXEL_SIGMA, TOUCH_SIGMA_M, BEAM_SIGMA_M = 0.1, 2e-4, 1e-3
SPOTS = ((0.285, 0.16), (-0.285, -0.16), (0.115, -0.205), (-0.115, 0.205))


def facing(point_m: tuple[float, ...], distance_m: float, sensor: str) -> RigidTransform:
    """Return `base_from_flange` with a sensor that faces a panel point at a right angle, by the nominal mount."""
    panel_from_sensor = RigidTransform.from_components(
        np.array([*point_m[:2], distance_m]), transform_rpy((0, 0, 0), (np.pi, 0, 0)).rotation
    )
    return BASE_FROM_PANEL * panel_from_sensor * MOUNTS[sensor].parent_from_child.inv()


def draw(rng: np.random.Generator) -> list[Observation]:
    """Return readings with every error drawn by its stated sigma; the error of each mount is drawn once."""
    mounts = {
        name: perturbed(m.parent_from_child, rng.normal(size=6) * np.sqrt(np.diag(m.covariance)))
        for name, m in MOUNTS.items()
    }
    observations: list[Observation] = []
    flange = facing((0.0, 0.0), 0.66, "camera")
    camera_from_panel = (flange * mounts["camera"]).inv() * BASE_FROM_PANEL
    for name, light in LIGHTS.items():
        pixel = project(camera_from_panel.apply(np.array(light))[None], LENS)[0] + rng.normal(size=2) * PIXEL_SIGMA
        observations.append(
            PixelObservation(
                sensor="camera",
                base_from_flange=flange,
                name=name,
                point_m=np.array(light),
                pixel_px=pixel,
                covariance_px=PIXEL_SIGMA**2 * np.eye(2),
                intrinsics=LENS,
            )
        )
    for spot in SPOTS:
        flange = facing(spot, 0.0, "grip")
        depth = depth_to_plate(flange * mounts["grip"]) + rng.normal() * TOUCH_SIGMA_M
        observations.append(
            TouchObservation(
                sensor="grip",
                base_from_flange=flange,
                tip_m=np.array([0.0, 0.0, depth]),
                sigma_m=TOUCH_SIGMA_M,
                label="touch",
            )
        )
        flange = facing(spot, 0.05, "beam")
        distance = depth_to_plate(flange * mounts["beam"]) + rng.normal() * BEAM_SIGMA_M
        observations.append(
            ProximityObservation(
                sensor="beam", base_from_flange=flange, distance_m=distance, sigma_m=BEAM_SIGMA_M, label="beam"
            )
        )
    return observations


def depth_to_plate(base_from_sensor: RigidTransform) -> float:
    """Return the distance to the plate along the sensor's z axis."""
    panel_from_sensor = BASE_FROM_PANEL.inv() * base_from_sensor
    return float(-panel_from_sensor.translation[2] / panel_from_sensor.rotation.apply([0.0, 0.0, 1.0])[2])


def test_the_stated_covariance_is_honest_although_readings_share_their_mounts() -> None:
    rng = np.random.default_rng(3)
    runs = 24
    distances = []
    for _ in range(runs):
        pose = fuse_observations(draw(rng), MOUNTS).base_from_panel
        delta = difference(BASE_FROM_PANEL, pose.parent_from_child)
        distances.append(delta @ np.linalg.solve(pose.covariance, delta))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs
    assert low < np.mean(distances) < high


def test_a_touch_on_something_else_is_named_and_not_used() -> None:
    observations = draw(np.random.default_rng(4))
    wrong = next(i for i, e in enumerate(observations) if isinstance(e, TouchObservation))
    touched = observations[wrong]
    assert isinstance(touched, TouchObservation)
    observations[wrong] = TouchObservation(
        sensor="grip",
        base_from_flange=touched.base_from_flange,
        tip_m=touched.tip_m - (0, 0, 0.02),
        sigma_m=TOUCH_SIGMA_M,
        label="knob",
    )
    answer = fuse_observations(observations, MOUNTS)
    assert [r.index for r in answer.fused.rejected] == [wrong]
    assert np.linalg.norm(difference(BASE_FROM_PANEL, answer.base_from_panel.parent_from_child)[:3]) < 0.003


@pytest.mark.parametrize("sensor", ["camera", "grip"])
def test_a_worse_mount_makes_a_less_certain_pose(sensor: str) -> None:
    observations = draw(np.random.default_rng(5))
    worse = {
        **MOUNTS,
        sensor: UncertainPose(parent_from_child=MOUNTS[sensor].parent_from_child, covariance=25 * MOUNT_COVARIANCE),
    }
    good = fuse_observations(observations, MOUNTS).base_from_panel.covariance
    bad = fuse_observations(observations, worse).base_from_panel.covariance
    assert np.trace(bad) > np.trace(good)
