"""Calibration of force/torque bias and tool weight from readings without contact in several poses of the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from hal.calibration import ToolLoad
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import skew

GRAVITY_M_PER_S2 = 9.80665
# Mean square of gravity's direction along its second principal axis, about its mean: 8 degrees of tilt.
LEAST_SPREAD = 0.02
LIMIT_KG = 0.05  # largest accepted standard deviation of the mass


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WrenchCalibration:
    """Bias of the sensor and weight of the tool below it.

    Attributes:
        load: mass, centre of mass and bias, sensor axes.
        covariance: 10x10 over force bias (N), mass (kg), torque bias (N m), mass times centre (kg m).
        rms_n, rms_nm: root mean square residuals of force and torque.
    """

    load: ToolLoad
    covariance: Array
    rms_n: float
    rms_nm: float


def calibrate_wrench(
    base_from_sensor: ArrayLike, wrenches: ArrayLike, *, gravity_base: ArrayLike = (0.0, 0.0, -GRAVITY_M_PER_S2)
) -> WrenchCalibration:
    """Estimate bias and weight from f_i = b_f + m g_i, t_i = b_t + c x (m g_i), with g_i the gravity in sensor axes.

    Both equations are linear in b_f, m, b_t and m c.

    Args:
        base_from_sensor: (N, 3, 3) rotations of the sensor; N >= 4, hand at rest.
        wrenches: (N, 6) readings fx fy fz (N) tx ty tz (N m): the wrench of the load on the sensor, sensor axes.
        gravity_base: (3,) m/s^2.

    Raises:
        InvalidRequest: wrong shapes, or not finite.
        NotObservable: gravity came from too few directions; `details["next_down"]` is the direction (sensor axes) that
            should point down next.
    """
    R, w, g = _checked(base_from_sensor, wrenches, gravity_base)
    pull = np.einsum("nji,j->ni", R, g)  # R^T g
    _check_directions(pull / np.linalg.norm(g))
    one = np.tile(np.eye(3), (len(R), 1))
    force_rows = np.hstack([one, pull.reshape(-1, 1)])
    torque_rows = np.hstack([one, np.vstack([-skew(p) for p in pull])])  # c x g = -[g]x c
    force, cov_f, rms_n = _solve(force_rows, w[:, :3].ravel())
    torque, cov_t, rms_nm = _solve(torque_rows, w[:, 3:].ravel())
    if np.sqrt(cov_f[3, 3]) > LIMIT_KG:
        raise NotObservable(
            f"the weight is uncertain by {np.sqrt(cov_f[3, 3]):.2f} kg", hint="hold the hand still and add poses"
        )
    mass = float(force[3])
    if mass <= 0.0:
        raise InvalidRequest(
            f"the weight comes out as {mass:.3f} kg", hint="check the sign of the wrench and the sensor's axes"
        )
    centre = torque[3:] / mass
    covariance = np.zeros((10, 10))
    covariance[:4, :4], covariance[4:, 4:] = cov_f, cov_t
    load = ToolLoad(
        mass_kg=mass, centre_of_mass_m=(float(centre[0]), float(centre[1]), float(centre[2])),
        bias=tuple(float(v) for v in (*force[:3], *torque[:3])),  # type: ignore[arg-type]  # six of them
    )  # fmt: skip
    return WrenchCalibration(load=load, covariance=covariance, rms_n=rms_n, rms_nm=rms_nm)


def _checked(base_from_sensor: ArrayLike, wrenches: ArrayLike, gravity_base: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the arguments of `calibrate_wrench` as arrays.

    Raises:
        InvalidRequest: they are not usable.
    """
    R, w, g = (np.asarray(a, float) for a in (base_from_sensor, wrenches, gravity_base))
    if R.ndim != 3 or R.shape[1:] != (3, 3) or w.shape != (len(R), 6) or g.shape != (3,) or len(R) < 4:
        raise InvalidRequest(
            f"expected N >= 4 rotations (N, 3, 3) and wrenches (N, 6), not {R.shape} and {w.shape}",
            hint="one wrench a pose",
        )
    for name, array in (("base_from_sensor", R), ("wrenches", w)):
        bad = np.flatnonzero(~np.isfinite(array).reshape(len(R), -1).all(axis=1))
        if len(bad):
            raise InvalidRequest(f"{name}[{bad[0]}] is not finite", hint="leave that pose out")
    return R, w, g


def _check_directions(down: Array) -> None:
    """Check that gravity, as directions (N, 3) in sensor axes, varied enough to separate weight from bias.

    Raises:
        NotObservable: it did not.
    """
    centred = down - down.mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred / len(down))
    if values[1] < LEAST_SPREAD:
        # Perpendicular to the mean direction, and to the direction in which it varied, if it varied.
        mean = down.mean(axis=0)
        weak = np.cross(mean, vectors[:, 2] if values[2] >= LEAST_SPREAD else np.eye(3)[int(np.argmin(np.abs(mean)))])
        weak /= np.linalg.norm(weak)
        words = np.round(weak, 2).tolist()
        raise NotObservable(
            "gravity came from too few directions to tell weight from bias",
            hint=f"turn the hand until {words} (sensor axes) points down, and again the other way",
            next_down=words,
        )


def _solve(rows: Array, values: Array) -> tuple[Array, Array, float]:
    """Solve a linear least-squares problem; returns solution, covariance and root mean square residual."""
    solution = np.linalg.lstsq(rows, values, rcond=None)[0]
    rest = values - rows @ solution
    variance = float(rest @ rest) / max(len(values) - rows.shape[1], 1)
    covariance = np.asarray(variance * np.linalg.inv(rows.T @ rows))
    return np.asarray(solution), covariance, float(np.sqrt(np.mean(rest**2)))
