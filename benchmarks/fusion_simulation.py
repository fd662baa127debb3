"""Simulated fusion problems: a panel with a block, measured by four senses with realistic noise and some mismatches.

Planning, tests, examples and benchmarks use it. Noise levels are those of data/fusion/README.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.distance import local_values
from fusion.features import Feature, Kind, box_features, plane, point
from fusion.measurement import Measurement, measurement
from hal.arrays import Array
from hal.geometry import matrix_of, transform

# Class and sense of each kind of sensing in Table I: v vision, t touch, p proximity, r range.
CODES = ("1v", "1t", "1p", "2t", "2p", "3t", "3p", "4v", "5v", "6t", "6p", "7r", "8v", "9t", "9p", "9r")
TABLE_II = ("1v", "1t", "2p", "8v", "9t", "4v", "6p", "3t", "5v", "7r", "3p", "1v", "6t", "9p", "2t", "1p")

FOCAL_PX, PIXEL_SIGMA_PX, CAMERA_SIGMA_M = 800.0, 0.5, 0.0003
STEREO_DEPTH_M, STEREO_LATERAL_M = 0.002, 0.0007
STEREO_LINE_RAD = (math.radians(0.5), math.radians(0.2))
POINT_SIGMA_M = {"t": 0.0002, "p": 0.001, "r": 0.002}
LINE_SIGMA_RAD = {
    sense: math.sqrt(2) * sigma / 0.1 for sense, sigma in POINT_SIGMA_M.items()
}  # two touches 100 mm apart
PLANE_SIGMA_RAD = {"t": 0.002, "p": 0.010, "r": math.radians(0.3)}
SENSED = {"1": Kind.POINT, "2": Kind.POINT, "3": Kind.POINT, "4": Kind.LINE, "5": Kind.LINE, "6": Kind.LINE,
          "7": Kind.PLANE, "8": Kind.PLANE, "9": Kind.PLANE}  # fmt: skip
MISMATCH_F = 100.0  # a wrong feature whose cost at the true pose is lower does not count as a mismatch


def panel() -> tuple[Feature, ...]:
    """Return the features of a 0.8 x 0.5 x 0.1 m panel, front at z = 0, with a block, a sloped face and six lights."""
    body = box_features((0, 0, -0.1), (0.8, 0.5, 0), name="panel")
    block = [f for f in box_features((0.1, 0.1, 0), (0.35, 0.3, 0.06), name="block") if f.point_m[2] > 0]
    lights = [point((x, y, 0), name=f"light {x:.2f} {y:.2f}") for x in (0.05, 0.4, 0.75) for y in (0.05, 0.45)]
    slope = plane((0.625, 0.175, 0.04), (0, -0.470588, 0.882353), name="slope")
    return (*body, *block, *lights, slope)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """Measurements of an object at a known pose; `bad` holds the indices of the mismatched ones."""

    base_from_object: RigidTransform
    measurements: tuple[Measurement, ...]
    bad: frozenset[int] = field(default=frozenset())


def random_pose(rng: np.random.Generator) -> RigidTransform:
    """Return a pose with random orientation, about a metre in front of the base."""
    return transform(Rotation.random(rng=rng).as_matrix(), rng.uniform([0.8, -0.4, 0.4], [1.6, 0.4, 1.2]))


def problem(
    codes: Sequence[str],
    rng: np.random.Generator,
    *,
    bad: int | Sequence[int] = 0,
    anisotropy: float = 1.0,
    features: Sequence[Feature] | None = None,
) -> Problem:
    """Return a problem with one measurement per code, each of a random feature of the right kind; some are mismatched.

    Args:
        codes: entries of `CODES`.
        rng: random generator for pose, features, mismatches and noise.
        bad: how many measurements, or which ones by index, are attributed to a wrong feature.
        anisotropy: condition number of random point covariances; 1 for the covariances of the sense.
        features: features of the object; by default `panel()`.
    """
    things = panel() if features is None else tuple(features)
    pose = random_pose(rng)
    wrong = set(rng.choice(len(codes), bad, replace=False).tolist()) if isinstance(bad, int) else set(bad)
    made = [_one(code, things, pose, rng, i in wrong, anisotropy) for i, code in enumerate(codes)]
    return Problem(base_from_object=pose, measurements=tuple(made), bad=frozenset(wrong))


def _one(
    code: str, things: Sequence[Feature], pose: RigidTransform, rng: np.random.Generator, wrong: bool, anisotropy: float
) -> Measurement:
    kind = list(Kind)[(int(code[0]) - 1) % 3]
    candidates = [f for f in things if f.kind == kind]
    while True:
        actual = candidates[rng.integers(len(candidates))]
        claimed = candidates[rng.integers(len(candidates))] if wrong else actual
        made = sense(code, actual, pose, rng, claimed=claimed, anisotropy=anisotropy)
        if not wrong or local_values([made], pose)[0] > MISMATCH_F:
            return made


def sense(
    code: str,
    actual: Feature,
    base_from_object: RigidTransform,
    rng: np.random.Generator,
    *,
    claimed: Feature | None = None,
    anisotropy: float = 1.0,
) -> Measurement:
    """Return a noisy measurement of kind `code` of `actual`, attributed to `claimed` (by default the same feature)."""
    R, t = matrix_of(base_from_object), base_from_object.translation
    x, u = R @ actual.point_m + t, R @ actual.direction
    sensed, sense_letter = SENSED[code[0]], code[1]
    if sense_letter == "v":
        mu, C, M = _by_camera(code[0], x, u, rng)
    else:
        mu, C, M = _by_contact(sensed, actual.kind, sense_letter, x, u, rng)
    if anisotropy > 1.0:
        C = _stretched(C, anisotropy, rng)
    mu = mu + _draw(C, rng)
    return measurement(claimed or actual, sensed, mu_m=mu, C_m2=C, M=M, label=code, sensor=sense_letter)


def _by_contact(
    sensed: Kind, kind: Kind, sense_letter: str, x: Array, u: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return mu without noise, C and M of touch, proximity or range sensing of a feature."""
    along = _on_feature(kind, u, rng)
    C = POINT_SIGMA_M[sense_letter] ** 2 * np.eye(3)
    if sensed == Kind.POINT:
        return x + along, C, np.zeros((3, 3))
    direction = _sensed_direction(sensed, kind, u, rng)
    sigma = (LINE_SIGMA_RAD if sensed == Kind.LINE else PLANE_SIGMA_RAD)[sense_letter]
    if sensed == Kind.PLANE and kind == Kind.POINT:
        along = 0.1 * np.cross(direction, rng.normal(size=3))
    _, M = _tilted(direction, (sigma, sigma), rng)
    return x + along, C, M


def _on_feature(kind: Kind, u: Array, rng: np.random.Generator) -> Array:
    """Return a random shift along the feature."""
    if kind == Kind.POINT:
        return np.zeros(3)
    if kind == Kind.LINE:
        return np.asarray(rng.uniform(-0.1, 0.1) * u)
    return np.asarray(0.05 * np.cross(u, rng.normal(size=3)))


def _sensed_direction(sensed: Kind, kind: Kind, u: Array, rng: np.random.Generator) -> Array:
    """Return the true direction of what is sensed: the feature's own, or a random one that the constraint allows."""
    if sensed == kind:
        return u
    if kind == Kind.POINT:
        return _unit(rng.normal(size=3))
    return _unit(np.cross(u, rng.normal(size=3)))


def _by_camera(cls: str, x: Array, u: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return mu, C and M of one or two cameras 0.8 to 1.3 m away, without the noise of mu."""
    eye = x + rng.uniform(0.8, 1.3) * _unit(rng.normal(size=3))
    ray = _unit(x - eye)
    C_eye = CAMERA_SIGMA_M**2 * np.eye(3)
    C_stereo = STEREO_LATERAL_M**2 * np.eye(3) + (STEREO_DEPTH_M**2 - STEREO_LATERAL_M**2) * np.outer(ray, ray)
    if cls == "1":
        return x, C_stereo, np.zeros((3, 3))
    if cls == "4":
        sigma = PIXEL_SIGMA_PX / FOCAL_PX
        return eye, C_eye, _tilted(ray, (sigma, sigma), rng)[1]
    if cls == "5":
        toward = _unit(ray - u * (u @ ray))
        _, axes = _tilted_about(u, toward, STEREO_LINE_RAD, rng)
        return x + rng.uniform(-0.1, 0.1) * u, C_stereo, _information_of(axes, STEREO_LINE_RAD)
    # Plane through camera and edge: its errors are rotations about the viewing ray and about the edge.
    normal = _unit(np.cross(ray, u))
    length_px = rng.uniform(100, 250)
    sigmas = (PIXEL_SIGMA_PX / FOCAL_PX / math.sqrt(2), PIXEL_SIGMA_PX * math.sqrt(2) / length_px)
    _, axes = _tilted_about(normal, ray, sigmas, rng)
    return eye, C_eye, _information_of(axes, sigmas)


def _tilted(direction: Array, sigmas: tuple[float, float], rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the direction with noise, and its information matrix."""
    seen, axes = _tilted_about(direction, _unit(np.cross(direction, rng.normal(size=3))), sigmas, rng)
    return seen, _information_of(axes, sigmas)


def _tilted_about(
    direction: Array, toward: Array, sigmas: tuple[float, float], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return `direction` tilted randomly, with sigmas[0] towards `toward` and sigmas[1] across; and the axes (2, 3)."""
    first = _unit(toward - direction * (direction @ toward))
    second = np.cross(direction, first)
    seen = _unit(direction + rng.normal(0, sigmas[0]) * first + rng.normal(0, sigmas[1]) * second)
    first = _unit(first - seen * (seen @ first))
    return seen, np.array([first, np.cross(seen, first)])


def _information_of(axes: Array, sigmas: tuple[float, float]) -> Array:
    return np.asarray(sum(np.outer(a, a) / s**2 for a, s in zip(axes, sigmas, strict=True)))


def _stretched(C: Array, condition: float, rng: np.random.Generator) -> Array:
    """Return a random covariance with the given condition number, the largest variance of C, and random axes."""
    axes = Rotation.random(rng=rng).as_matrix()
    variances = np.linalg.eigvalsh(C)[2] * np.array([1.0, condition**-0.5, 1.0 / condition])
    return np.asarray(axes @ np.diag(variances) @ axes.T)


def _draw(C: Array, rng: np.random.Generator) -> Array:
    return np.asarray(np.linalg.cholesky(C) @ rng.normal(size=3))


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))
