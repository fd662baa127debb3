"""Tests of each sense's measurement: its class, zero residual without noise, chi-square with noise of every source."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import Measurement, SensingClass, sensing
from fusion.distance import local_value
from fusion.features import line, plane, point
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, certain, matrix_of, perturbed, transform

CAMERA = sensing.Pinhole(fx_px=800.0, fy_px=790.0, cx_px=320.0, cy_px=240.0)
POSE_SIGMA = np.array([3e-4] * 3 + [1e-3] * 3)
POINT, LINE, PLANE = point((0.1, 0.2, 0.0)), line((0.1, 0.2, 0.0), (1, 0, 0)), plane((0.1, 0.2, 0.0), (0, 0, 1))


class Scene:
    """Object with two cameras and a finger around it; `noise` 1 draws every error, 0 none."""

    def __init__(self, seed: int, noise: float) -> None:
        self.rng, self.noise = np.random.default_rng(seed), noise
        self.pose = transform(Rotation.random(rng=self.rng).as_matrix(), self.rng.normal(0, 0.3, 3))
        R = matrix_of(self.pose)
        self.x, self.along, self.normal = self.pose.apply(POINT.point_m), R[:, 0], R[:, 2]
        self.cameras = [self.look_from(R @ np.array(p)) for p in ([0.1, -0.2, 1.0], [0.25, 0.3, 0.9])]
        self.known = [self.uncertain(c) for c in self.cameras]

    def look_from(self, offset: Array) -> RigidTransform:
        z = -offset / np.linalg.norm(offset)
        x = np.cross(z, self.rng.normal(size=3))
        x /= np.linalg.norm(x)
        return transform(np.column_stack([x, np.cross(z, x), z]), self.x + offset)

    def uncertain(self, true: RigidTransform) -> UncertainPose:
        """Return the pose with the arm's error."""
        return UncertainPose(
            parent_from_child=perturbed(true, -self.noise * self.rng.normal(0, POSE_SIGMA)),
            covariance=np.diag(POSE_SIGMA**2),
        )

    def draw(self, sigma: float, size: int) -> Array:
        return self.noise * self.rng.normal(0, sigma, size)

    def pixel(self, camera: int, place: Array) -> Array:
        q = self.cameras[camera].inv().apply(place)
        return np.array([800 * q[0] / q[2] + 320, 790 * q[1] / q[2] + 240]) + self.draw(0.5, 2)

    def ends(self, camera: int, direction: Array) -> list[Array]:
        return [self.pixel(camera, self.x - 0.1 * direction), self.pixel(camera, self.x + 0.1 * direction)]


def touched(s: Scene) -> Measurement:
    true = transform(matrix_of(s.pose), s.x + 0.03 * s.along - 0.1 * s.normal)
    tip = np.array([0.0, 0.0, 0.1]) + s.draw(2e-4, 3)
    return sensing.touch(PLANE, s.uncertain(true), tip_m=tip, sigma_m=2e-4)


def approached(s: Scene) -> Measurement:
    true = transform(matrix_of(s.pose) @ np.diag([1.0, -1.0, -1.0]), s.x + 0.05 * s.normal)
    distance = 0.05 + float(s.draw(1e-3, 1)[0])
    return sensing.proximity(PLANE, s.uncertain(true), distance_m=distance, sigma_m=1e-3, lateral_sigma_m=2e-3)


def seen(s: Scene) -> Measurement:
    return sensing.pixel(POINT, s.known[0], pixel_px=s.pixel(0, s.x), sigma_px=0.5, camera=CAMERA)


def edge_seen(s: Scene) -> Measurement:
    return sensing.image_line(LINE, s.known[0], ends_px=s.ends(0, s.along), sigma_px=0.5, camera=CAMERA)


def ranged(s: Scene) -> Measurement:
    to_camera = s.cameras[0].inv()
    n = to_camera.rotation.apply(s.normal)
    tilt = Rotation.from_rotvec(np.cross(n, s.draw(0.005, 3)))
    place = to_camera.apply(s.x + 0.03 * s.along) + s.draw(0.002, 1) * n
    return sensing.range_plane(
        PLANE, s.known[0], point_m=place, normal=tilt.apply(n), offset_sigma_m=0.002, normal_sigma_rad=0.005
    )


SENSES: dict[Callable[[Scene], Measurement], SensingClass] = {
    touched: SensingClass.POINT_PLANE,
    approached: SensingClass.POINT_PLANE,
    seen: SensingClass.LINE_POINT,
    edge_seen: SensingClass.PLANE_LINE,
    ranged: SensingClass.PLANE_PLANE,
}


@pytest.mark.parametrize("sense", SENSES, ids=lambda f: f.__name__)
def test_without_noise_the_true_pose_fits_exactly(sense: Callable[[Scene], Measurement]) -> None:
    for seed in range(3):
        scene = Scene(seed, 0.0)
        made = sense(scene)
        assert made.cls == SENSES[sense]
        assert local_value(made, scene.pose) < 1e-7  # M of 1e6 and more times the rounding error of a unit vector


@pytest.mark.parametrize("sense", SENSES, ids=lambda f: f.__name__)
def test_sensor_and_pose_noise_together_give_the_chi_square(sense: Callable[[Scene], Measurement]) -> None:
    scenes = [Scene(seed, 1.0) for seed in range(40)]
    made = [sense(s) for s in scenes]
    f = np.array([local_value(m, s.pose) for m, s in zip(made, scenes, strict=True)])
    dof = made[0].dof
    assert f.mean() == pytest.approx(dof, abs=4.5 * np.sqrt(2 * dof / len(f)))


def test_the_arm_pose_enters_the_covariance() -> None:
    finger = transform(np.eye(3), (0.4, 0.1, 0.2))
    sure = sensing.touch(PLANE, certain(finger), sigma_m=2e-4)
    unsure = sensing.touch(
        PLANE, UncertainPose(parent_from_child=finger, covariance=np.diag([1e-6] * 3 + [0.0] * 3)), sigma_m=2e-4
    )
    assert np.diag(sure.C_m2) == pytest.approx(4e-8, rel=1e-3)
    assert np.diag(unsure.C_m2) == pytest.approx(1.04e-6, rel=1e-3)


def test_the_feature_decides_the_class() -> None:
    finger = certain(transform(np.eye(3), (0.4, 0.1, 0.2)))
    classes = [sensing.touch(f, finger, sigma_m=1e-3).cls for f in (POINT, LINE, PLANE)]
    assert classes == [SensingClass.POINT_POINT, SensingClass.POINT_LINE, SensingClass.POINT_PLANE]


def test_a_known_turn_of_the_arm_is_a_lever_on_far_points() -> None:
    turned = UncertainPose(
        parent_from_child=transform(np.eye(3), np.zeros(3)), covariance=np.diag([0, 0, 0, 0, 0, 1e-6])
    )
    made = sensing.range_point(PLANE, turned, point_m=(1.0, 0, 0), covariance_m2=1e-8 * np.eye(3))
    assert made.C_m2[1, 1] == pytest.approx(1e-6 + 1e-8, rel=1e-3)
    assert made.C_m2[0, 0] == pytest.approx(1e-8, rel=0.2)


def test_an_image_line_needs_two_points() -> None:
    with pytest.raises(InvalidRequest, match="coincide"):
        sensing.image_line(
            LINE, certain(transform(np.eye(3), np.zeros(3))), ends_px=[[1, 1], [1, 1]], sigma_px=0.5, camera=CAMERA
        )
