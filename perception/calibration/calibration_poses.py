"""Selection of the most informative poses for calibrating a sensor on the hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.geometry import certain, matrix_of, transform
from perception.calibration.hand_eye import propose_next, stations
from perception.calibration.hand_eye_equation import HandEyeView

EDGE_PX = 24.0  # a light nearer to the image's edge may be cut off
LIGHTS_CONE_RAD = 0.95  # half angle; with 0.6 rad the camera's position along its axis would be 1.5 times as uncertain
PLATE_CONE_RAD = 0.6
REACH_STEPS = (0.8, 1.0, 1.2, 1.45, 1.7)  # distances, relative to the shortest one from which everything is in view
# Standard deviations of a pose from a scan; a plane does not determine shifts in it and rotations about its normal.
PLATE_SIGMA = (1.0, 1.0, 2e-4, 5e-4, 5e-4, 1.0)
WRIST_RAD = (-2.4, -1.6, -0.8, 0.0, 0.8, 1.6, 2.4)  # tried angles of the wrist's joints, relative to the parking place

Propose = Callable[[Sequence[RigidTransform], Sequence[RigidTransform]], int]
"""A function of the flange poses so far and the candidates that returns the index of the best candidate."""


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
    """Return a function that proposes the most informative pose for a sensor that sees a plate."""

    def propose(done: Sequence[RigidTransform], candidates: Sequence[RigidTransform]) -> int:
        views = [
            HandEyeView(
                base_from_flange=flange,
                camera_from_target=certain((flange * flange_from_sensor).inv() * base_from_plate),
            )
            for flange in done
        ]
        return propose_next(views, (flange_from_sensor, base_from_plate), candidates, view_covariance=plate_view)[0]

    return propose


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
