"""The height of a cap in a range image: right within its sigma, and None where the image does not show a cap."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.panel import Cap
from perception.range import PinholeSensor, measure_cap

SENSOR = PinholeSensor(width_px=128, height_px=128, fx_px=110.0, fy_px=110.0, cx_px=63.5, cy_px=63.5)
CAP = Cap(radius_m=0.013, height_m=0.008, pressed_depth_m=0.003)
SIGMA_M = 0.0005


def image(height_m: float, foot_from_sensor: RigidTransform, noise: np.random.Generator) -> Array:
    """Return the depth image (128, 128) of a plate at z = 0 with a cap at the origin, with noise."""
    rays = SENSOR.points(np.ones((128, 128)))
    along, start = foot_from_sensor.rotation.apply(rays.reshape(-1, 3)), foot_from_sensor.translation
    depth = -start[2] / along[:, 2]
    on_cap = (height_m - start[2]) / along[:, 2]
    x, y, _ = (start + on_cap[:, None] * along).T
    depth = np.where(np.hypot(x, y) < CAP.radius_m, on_cap, depth)
    return (depth + SIGMA_M * noise.standard_normal(depth.shape)).reshape(128, 128)


def view(noise: np.random.Generator) -> RigidTransform:
    """Return a sensor pose some 0.36 m in front of the plate, a little tilted."""
    tilt = Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(noise.normal(0, 0.08, 3))
    return RigidTransform.from_components([0.01, -0.008, 0.36], tilt)


@pytest.mark.parametrize("height_m", [0.008, 0.005, 0.0065])
def test_the_height_is_right_within_its_sigma(height_m: float) -> None:
    off = []
    for seed in range(40):
        noise = np.random.default_rng(seed)
        pose = view(noise)
        believed = RigidTransform.from_translation([0.001, -0.001, 0.0012]) * pose  # the pose of a panel errs
        measured = measure_cap(
            image(height_m, pose, noise), SENSOR, CAP, foot_from_sensor=believed, sensor_sigma_m=SIGMA_M
        )
        assert measured is not None
        off.append((measured.height_m - height_m) / measured.sigma_m)
    assert np.abs(off).max() < 3.0
    assert np.sqrt(np.mean(np.square(off))) < 1.2


@pytest.mark.parametrize("height_m", [0.001, 0.014])
def test_what_cannot_be_the_cap_has_no_height(height_m: float) -> None:
    noise = np.random.default_rng(1)
    pose = view(noise)
    depth = image(height_m, pose, noise)
    assert measure_cap(depth, SENSOR, CAP, foot_from_sensor=pose, sensor_sigma_m=SIGMA_M) is None


def test_a_cap_that_gives_no_echo_has_no_height() -> None:
    noise = np.random.default_rng(1)
    pose = view(noise)
    depth = image(CAP.height_m, pose, noise)
    x, y, _ = np.moveaxis(pose.apply(SENSOR.points(depth).reshape(-1, 3)).reshape(128, 128, 3), -1, 0)
    depth[np.hypot(x, y) < CAP.radius_m] = np.nan
    assert measure_cap(depth, SENSOR, CAP, foot_from_sensor=pose, sensor_sigma_m=SIGMA_M) is None
