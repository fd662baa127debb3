"""Zero of a proximity sensor: how far it sits behind the fingertips, from readings against a plate at known distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.calibration import MountRecord
from hal.errors import NotObservable

LEAST_READINGS = 3
LEAST_SPAN_M = 0.01
BLOCK_SIGMA_M = 0.0003  # gauge blocks, and fingers held square to the plate by eye
MOST_RMS_M = 0.01
MOST_SCALE_OFF, SCALE_SIGMAS = 0.05, 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProximityZero:
    """Place of a proximity sensor along the fingers.

    Attributes:
        z_m: of its zero in the flange frame; `sigma_m` of it.
        rms_m: scatter of the readings.
        scale: by how much the readings grow with the distance; it was found to agree with 1.
    """

    z_m: float
    sigma_m: float
    rms_m: float
    scale: float


def calibrate_zero(distances_m: Array, readings_m: Array, *, mount: MountRecord, tip: MountRecord) -> ProximityZero:
    """Find the z of a proximity sensor's zero in the flange frame from readings r at distances d of a plate.

    The plate is square to the fingers and d in front of their tips, so it is at z_tip + d; with the sensor's beam turned
    by its mount, z = z_tip + d - r a, where a is the cosine between the beam and the flange's z axis.

    Args:
        distances_m: (n,) from the fingertips to the plate; readings_m: (n,) of the sensor.
        mount: the sensor's, for the direction of its beam; tip: the gripper's, whose position is that of the fingertips.

    Raises:
        NotObservable: too few or too similar distances, or readings that do not follow them.
    """
    span_m = float(np.ptp(distances_m)) if len(distances_m) else 0.0
    if len(distances_m) < LEAST_READINGS or span_m < LEAST_SPAN_M:
        raise NotObservable(
            f"{len(distances_m)} readings over {1e3 * span_m:.0f} mm do not give the zero",
            hint=f"read at {LEAST_READINGS} distances or more, such as 30, 50 and 80 mm",
        )
    a = float(mount.pose().parent_from_child.rotation.apply([0.0, 0.0, 1.0])[2])
    z_m = tip.position_m[2] + distances_m - readings_m * a
    rms_m = float(np.std(z_m, ddof=1))
    apart_m = distances_m - distances_m.mean()
    scale = float(apart_m @ (readings_m * a)) / float(apart_m @ apart_m)
    scale_sigma = max(rms_m, BLOCK_SIGMA_M) / float(np.sqrt(apart_m @ apart_m))
    if abs(scale - 1.0) > max(MOST_SCALE_OFF, SCALE_SIGMAS * scale_sigma) or rms_m > MOST_RMS_M:
        raise NotObservable(
            f"the readings grow {scale:.2f} times as much as the distances, and scatter by {1e3 * rms_m:.1f} mm",
            hint="give both in metres, hold the fingers square to the plate, and check the sensor's unit",
        )
    own_m = max(rms_m, BLOCK_SIGMA_M) / np.sqrt(len(distances_m))
    return ProximityZero(
        z_m=float(z_m.mean()), sigma_m=float(np.hypot(own_m, tip.sigma_m[2])), rms_m=rms_m, scale=scale
    )
