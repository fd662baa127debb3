"""Selection of the most informative poses for calibrating a sensor on the hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.geometry import matrix_of, skew, transform

EDGE_PX = 24.0  # a light nearer to the image's edge may be cut off
LIGHTS_CONE_RAD = 0.95  # half angle; with 0.6 rad the camera's position along its axis would be 1.5 times as uncertain
PLATE_CONE_RAD = 0.6
REACH_STEPS = (0.8, 1.0, 1.2, 1.45, 1.7)  # distances, relative to the shortest one from which everything is in view
# Standard deviations of a pose from a scan; a plane does not determine shifts in it and rotations about its normal.
PLATE_SIGMA = (1.0, 1.0, 2e-4, 5e-4, 5e-4, 1.0)
ARM_SIGMA = 1e-4  # repeatability of the arm, m and rad
ROUGHLY = np.tile(np.repeat([0.1, 0.3], 3), 2)  # prior standard deviations of mount and plate, m and rad
WRIST_RAD = (-2.4, -1.6, -0.8, 0.0, 0.8, 1.6, 2.4)  # tried angles of the wrist's joints, relative to the parking place

Propose = Callable[[Sequence[RigidTransform], Sequence[RigidTransform]], int]
"""A function of the flange poses so far and the candidates that returns the index of the best candidate."""


def stations(
    base_from_target: RigidTransform, flange_from_camera: RigidTransform, *, distance_m: float, count: int = 40,
    cone_rad: float = 0.7,
) -> list[RigidTransform]:  # fmt: skip
    """Return flange poses from which the camera looks at the target's middle, in a cone about its normal (z).

    They lie on a spiral (golden angle), so that any number of them covers the cone evenly, and have different rolls.
    """
    found = []
    for k in range(count):
        tilt = cone_rad * np.sqrt((k + 0.5) / count)
        azimuth = k * np.pi * (3.0 - np.sqrt(5.0))
        away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        z = -away
        x = np.array([1.0, 0.0, 0.0]) - z[0] * z
        x /= np.linalg.norm(x)
        looking = transform(np.column_stack([x, np.cross(z, x), z]), distance_m * away)
        roll = transform(Rotation.from_rotvec([0.0, 0.0, cone_rad * np.sin(2.4 * k)]).as_matrix(), np.zeros(3))
        found.append(base_from_target * looking * roll * flange_from_camera.inv())
    return found


def around(
    base_from_target: RigidTransform, flange_from_sensor: RigidTransform, distance_m: float, *, steps: Sequence[float],
    cone_rad: float,
) -> list[RigidTransform]:  # fmt: skip
    """Return flange poses from which the sensor looks at the target's middle.

    They lie in a cone, at several distances (`steps` times `distance_m`), with four rolls about the line of sight.
    """
    found = []
    for share in steps:
        for k, flange in enumerate(
            stations(base_from_target, flange_from_sensor, distance_m=share * distance_m, count=30, cone_rad=cone_rad)
        ):
            turn = Rotation.from_rotvec([0.0, 0.0, (k % 4) * np.pi / 2])
            roll = transform(turn.as_matrix(), np.zeros(3))
            found.append(flange * flange_from_sensor * roll * flange_from_sensor.inv())
    return found


def in_view(
    flange: RigidTransform, flange_from_camera: RigidTransform, base_from_points: RigidTransform, points_m: Array,
    lens: CameraIntrinsics,
) -> bool:  # fmt: skip
    """Return whether all points are in the image, at least `EDGE_PX` from its edge."""
    seen = ((flange * flange_from_camera).inv() * base_from_points).apply(points_m)
    if (seen[:, 2] < 0.1).any():
        return False
    pixels = project(seen, lens)
    limit = np.array([lens.width_px, lens.height_px]) - EDGE_PX
    return bool((pixels > EDGE_PX).all() and (pixels < limit).all())


def plate_view(target: RigidTransform) -> Array:
    """Return the expected covariance (6, 6) of a pose from a scan of the plate: it determines height and tilts only."""
    turn = np.kron(np.eye(2), matrix_of(target))
    return np.asarray(turn @ np.diag(np.square(PLATE_SIGMA)) @ turn.T)


def by_plate(flange_from_sensor: RigidTransform, base_from_plate: RigidTransform) -> Propose:
    """Return a function that proposes the pose after which the mount of a sensor that sees a plate is known best."""

    def propose(done: Sequence[RigidTransform], candidates: Sequence[RigidTransform]) -> int:
        known = np.diag(ROUGHLY**-2.0)
        for flange in done:
            known += _information(flange, flange_from_sensor, base_from_plate)
        covariances = [
            np.linalg.inv(known + _information(flange, flange_from_sensor, base_from_plate)) for flange in candidates
        ]
        return int(np.argmin([np.linalg.slogdet(covariance[:6, :6])[1] for covariance in covariances]))

    return propose


def _information(flange: RigidTransform, x: RigidTransform, z: RigidTransform) -> Array:
    """Return the information (12, 12) about mount X and plate Z of a scan B = X^-1 A^-1 Z from the flange pose A.

    The residual is that of the hand-eye equation A X B = Z, with noise of the arm and of the scan (`plate_view`).
    """
    plate = (flange * x).inv() * z
    Ra, Rx = matrix_of(flange), matrix_of(x)
    lever = Rx @ plate.translation
    none = np.zeros((3, 3))
    by_a = np.block([[np.eye(3), -skew(Ra @ (x.translation + lever))], [none, np.eye(3)]])
    by_x = np.block([[Ra, -Ra @ skew(lever)], [none, Ra]])
    by_b = block_diag(Ra @ Rx, Ra @ Rx)
    noise = ARM_SIGMA**2 * by_a @ by_a.T + by_b @ plate_view(plate) @ by_b.T
    J = np.hstack([by_x, -np.eye(6)])
    return np.asarray(J.T @ np.linalg.solve(noise, J))


def wrist_turns(
    park_rad: Array, limits_rad: tuple[Array, Array], base_from_sensor: Callable[[Array], Array]
) -> list[Array]:
    """Return joint vectors around the parking place with different wrist angles, in the order of their use.

    Each next one adds most to the information about the direction of gravity in sensor axes.

    Args:
        limits_rad: lowest and highest joint vector.
        base_from_sensor: returns the (3, 3) rotation of the sensor at a joint vector.
    """
    low, high = limits_rad
    grid = [
        park_rad + np.concatenate([np.zeros(len(park_rad) - 3), turn])
        for turn in np.array(np.meshgrid(WRIST_RAD, WRIST_RAD, (-1.2, 0.0, 1.2))).reshape(3, -1).T
    ]
    left = [q for q in grid if (q > low + 0.02).all() and (q < high - 0.02).all()]
    down = [base_from_sensor(q)[2] for q in left]  # the base's z axis in sensor axes
    information = 1e-3 * np.eye(3)
    ordered: list[Array] = []
    while left:
        # Greedy D-optimal design over the directions of gravity.
        gain = [float(d @ np.linalg.solve(information, d)) for d in down]
        best = int(np.argmax(gain))
        d = down.pop(best)
        ordered.append(left.pop(best))
        information += np.outer(d, d)
    return ordered
