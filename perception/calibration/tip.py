"""Tool centre point from touching one fixed point with the tip of the tool, with the hand turned differently each time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import NotObservable

LEAST_TOUCHES = 4
TOUCH_SIGMA_M = 0.0003  # how exactly a person brings a tip to a pin; the scatter replaces it if that is larger
MOST_SIGMA_M = 0.003  # with a larger uncertainty the hand was turned too little
MOST_RMS_M = 0.003


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TipCalibration:
    """The tip of the tool.

    Attributes:
        flange_from_tip_m: (3,) the tip in the flange frame; `covariance_m2`: (3, 3) of it.
        touched_m: (3,) the point that was touched, base frame.
        rms_m: scatter of the touches, per axis.
    """

    flange_from_tip_m: Array
    covariance_m2: Array
    touched_m: Array
    rms_m: float


def calibrate_tip(base_from_flanges: Sequence[RigidTransform]) -> TipCalibration:
    """Find the tip t and the touched point c with R_i t + p_i = c for all flange poses, by linear least squares.

    Raises:
        NotObservable: fewer than four touches, the hand was turned too little, or the touches scatter too much.
    """
    if len(base_from_flanges) < LEAST_TOUCHES:
        raise NotObservable(
            f"{len(base_from_flanges)} touches do not give the tip", hint=f"touch the pin from {LEAST_TOUCHES} sides"
        )
    R = np.stack([np.asarray(pose.rotation.as_matrix()) for pose in base_from_flanges])
    p = np.stack([np.asarray(pose.translation) for pose in base_from_flanges])
    A = np.hstack([R.reshape(-1, 3), np.tile(-np.eye(3), (len(p), 1))])
    information = A.T @ A
    if np.linalg.eigvalsh(information)[0] < 1e-6:
        raise _too_little_turned()
    solution = np.linalg.solve(information, -A.T @ p.ravel())
    rest = A @ solution + p.ravel()
    rms_m = float(np.sqrt(rest @ rest / (len(rest) - 6)))
    if rms_m > MOST_RMS_M:
        raise NotObservable(
            f"the touches scatter by {1e3 * rms_m:.1f} mm",
            hint="touch the same point each time; the pendant's TCP must be the flange (all zeros), positions in metres",
        )
    covariance = max(rms_m, TOUCH_SIGMA_M) ** 2 * np.linalg.inv(information)[:3, :3]
    if float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) > MOST_SIGMA_M:
        raise _too_little_turned()
    return TipCalibration(flange_from_tip_m=solution[:3], covariance_m2=covariance, touched_m=solution[3:], rms_m=rms_m)


def _too_little_turned() -> NotObservable:
    return NotObservable(
        "the hand was turned too little between the touches", hint="turn it by 60 degrees or more, about two axes"
    )
