"""Simulated four-light problems with their Cramer-Rao bound, in the schema of the development set.

This module does not use `perception`: the bound and the errors in the table are computed by its own formulae.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hal.arrays import Array

Problem = dict[str, Any]

SHAPES: dict[str, list[list[float]]] = {
    "coplanar-300x200": [[-0.15, -0.1, 0.0], [0.15, -0.1, 0.0], [0.15, 0.1, 0.0], [-0.15, 0.1, 0.0]],
    "coplanar-700x400": [[-0.35, -0.2, 0.0], [0.35, -0.2, 0.0], [0.35, 0.2, 0.0], [-0.35, 0.2, 0.0]],
    "noncoplanar-300x200": [[-0.15, -0.1, 0.0], [0.15, -0.1, 0.03], [0.15, 0.1, 0.0], [-0.15, 0.1, 0.06]],
    "parallelogram": [[-0.15, -0.1, 0.0], [0.12, -0.1, 0.0], [0.2, 0.1, 0.0], [-0.07, 0.1, 0.0]],
    "one-right-angle": [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.24, 0.17, 0.0], [0.0, 0.2, 0.0]],
    "irregular": [[-0.16, -0.07, 0.0], [0.11, -0.12, 0.0], [0.17, 0.08, 0.0], [-0.1, 0.13, 0.0]],
}


def problems(
    seed: int, count: int, *, shapes: list[str], tilt_deg: tuple[float, float], sigma_px: list[float],
    range_m: list[float],
) -> list[Problem]:  # fmt: skip
    """Return `count` random views that have all four lights inside a 1280x960 image."""
    rng = np.random.default_rng(seed)
    made: list[Problem] = []
    while len(made) < count:
        shape = str(rng.choice(shapes))
        problem = _problem(
            rng, shape, float(rng.uniform(*tilt_deg)), float(rng.choice(sigma_px)), float(rng.choice(range_m))
        )
        if problem is not None:
            problem["id"] = f"sim-{seed}-{len(made):05d}"
            made.append(problem)
    return made


def _problem(rng: np.random.Generator, shape: str, tilt_deg: float, sigma_px: float, range_m: float) -> Problem | None:
    X = np.array(SHAPES[shape])
    if shape in ("parallelogram", "one-right-angle", "irregular"):  # an arbitrary object frame
        X = X @ Rotation.random(random_state=rng).as_matrix().T + rng.normal(scale=0.1, size=3)
    camera = {"fx": rng.uniform(780, 820), "fy": rng.uniform(780, 820), "cx": rng.uniform(620, 660),
              "cy": rng.uniform(465, 495), "width": 1280.0, "height": 960.0}  # fmt: skip
    normal = np.linalg.svd(X - X.mean(axis=0))[2][2]
    R = _facing(normal, rng, np.radians(tilt_deg))
    centre = np.array([rng.uniform(-0.13, 0.13), rng.uniform(-0.13, 0.13), 1.0]) * range_m
    t = centre - R @ X.mean(axis=0)
    pixels = pixels_of(X, R, t, camera)
    if not (np.isfinite(pixels).all() and (pixels > 0).all() and (pixels < [1280, 960]).all()):
        return None
    bound = cramer_rao(X, R, t, camera, sigma_px)
    noisy = pixels + rng.normal(scale=sigma_px, size=(4, 2))
    return {
        "cell": f"{shape}|{tilt_deg:.0f}", "K": camera, "sigma_px": sigma_px, "points_obj": X.tolist(),
        "points_img": noisy.tolist(), "R_true": R.tolist(), "t_true": t.tolist(), "bound": bound, "tilt_deg": tilt_deg,
    }  # fmt: skip


def _facing(normal: Array, rng: np.random.Generator, tilt_rad: float) -> Array:
    """Return a rotation that shows a plane's front to the camera, tilted from the optical axis, with random roll."""
    onto = Rotation.align_vectors([[0.0, 0.0, -1.0]], [normal])[0]
    azimuth = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(tilt_rad * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    return np.asarray((tilt * Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]) * onto).as_matrix())


def pixels_of(X: Array, R: Array, t: Array, camera: dict[str, float]) -> Array:
    """Return the (N, 2) pixels of (N, 3) object points; NaN behind the camera."""
    q = X @ R.T + t
    z = np.where(q[:, 2:] > 0, q[:, 2:], np.nan)
    return np.asarray(q[:, :2] / z * [camera["fx"], camera["fy"]] + [camera["cx"], camera["cy"]])


def cramer_rao(X: Array, R: Array, t: Array, camera: dict[str, float], sigma_px: float) -> Array:
    """Return the 6x6 bound sigma^2 (J^T J)^-1, rotation first as in the development set; J by central differences."""
    columns = []
    for k in range(6):
        ahead, back = (_moved(R, t, h * np.eye(6)[k]) for h in (1e-6, -1e-6))
        columns.append((pixels_of(X, *ahead, camera) - pixels_of(X, *back, camera)).ravel() / 2e-6)
    J = np.stack(columns, axis=1)
    return np.asarray(sigma_px**2 * np.linalg.inv(J.T @ J))


def _moved(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    return Rotation.from_rotvec(step[:3]).as_matrix() @ R, t + step[3:]


def error(problem: Problem, R: Array, t: Array) -> Array:
    """Return the (6,) rotation vector and translation from the estimate to the truth."""
    turn = Rotation.from_matrix(np.array(problem["R_true"]) @ R.T).as_rotvec()
    return np.concatenate([turn, np.array(problem["t_true"]) - t])


def is_flipped(problem: Problem, R: Array) -> bool:
    """Return whether the estimated normal is nearer to the mirrored true one, and more than 5 degrees off."""
    X, Rt, tt = (np.array(problem[k]) for k in ("points_obj", "R_true", "t_true"))
    normal = np.linalg.svd(X - X.mean(axis=0))[2][2]
    sight = Rt @ X.mean(axis=0) + tt
    sight /= np.linalg.norm(sight)
    true, found = Rt @ normal, R @ normal
    mirror = 2.0 * (true @ sight) * sight - true
    return bool(found @ mirror > found @ true and np.degrees(np.arccos(np.clip(found @ true, -1, 1))) > 5.0)
