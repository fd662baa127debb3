"""First-order propagation of all uncertainties into C and M of the distance function (paper eq 13)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fusion.features import Feature, Kind
from fusion.measurement import Measurement, measurement
from hal.arrays import Array
from hal.geometry import UncertainPose, matrix_of, skew

SMALLEST_SIGMA_M = 1e-6  # no position is known better than a micrometre
SMALLEST_SIGMA_RAD = 1e-6
STEP = 1e-5  # of the central differences, in the unit of the parameter (m, rad or px)


def sensed_by(
    feature: Feature,
    sensed_kind: Kind,
    sensed: Callable[[Array], tuple[Array, Array]],
    own: Array,
    pose: UncertainPose,
    label: str,
    sensor: str,
) -> Measurement:
    """Return a measurement from a point and direction in a sensor's frame that depend on errors of covariance `own`."""
    k = len(own)

    def in_base(x: Array) -> tuple[Array, Array]:
        place, direction = sensed(x[:k])
        origin, R = moved(pose, x[k : k + 6])
        return origin + R @ place, R @ direction

    return from_joint(feature, sensed_kind, in_base, block_diagonal([own, pose.covariance]), label, sensor)


def from_joint(
    feature: Feature,
    sensed_kind: Kind,
    sensed: Callable[[Array], tuple[Array, Array]],
    covariance: Array,
    label: str,
    sensor: str,
) -> Measurement:
    """Return a measurement from a point and direction in the base that depend on errors x with `covariance`."""
    place, direction = sensed(np.zeros(len(covariance)))

    def joined(x: Array) -> Array:
        p, d = sensed(x)
        return np.concatenate([p, d if d @ direction > 0 else -d])

    J = jacobian(joined, len(covariance))
    joint = J @ covariance @ J.T
    shift = _best_known(joint, direction, sensed_kind)
    K = np.hstack([np.eye(3), _lever(shift, direction)])
    return measurement(
        feature,
        sensed_kind,
        mu_m=place + shift,
        C_m2=floored(K @ joint @ K.T),
        M=_information(joint[3:, 3:], direction),
        label=label,
        sensor=sensor,
    )


def _lever(shift: Array, direction: Array) -> Array:
    """Return d(shift)/d(direction) when the shifted point stays on the line or plane, so that both turn together."""
    along = float(shift @ direction)
    across = shift - along * direction
    # on a line the point moves with the direction; on a plane it moves against the normal's tilt
    return along * np.eye(3) - np.outer(direction, across)


def _best_known(joint: Array, direction: Array, kind: Kind) -> Array:
    """Return the shift along the line, or in the plane, to the point whose error is least coupled to the direction's.

    eq 13 has no term between point and direction, so they should be independent where it is evaluated.
    """
    P = np.eye(3) - np.outer(direction, direction)
    spread, coupled = P @ joint[3:, 3:] @ P, joint[:3, 3:]
    if kind == Kind.LINE:
        total = float(np.trace(spread))
        return np.asarray(-np.trace(P @ coupled) / total * direction) if total > 0 else np.zeros(3)
    # offset error d.dp - s.dd is uncoupled from dd where s = spread^+ coupled^T d
    return np.asarray(P @ np.linalg.pinv(spread, rcond=1e-6) @ (P @ coupled.T @ direction))


def _information(spread: Array, direction: Array) -> Array:
    """Return M: the inverse of a direction's covariance (3, 3) across the direction, zero along it."""
    T = np.linalg.svd(direction[None])[2][1:].T
    across = T.T @ spread @ T + SMALLEST_SIGMA_RAD**2 * np.eye(2)
    return np.asarray(T @ np.linalg.inv(across) @ T.T)


def floored(C: Array) -> Array:
    """Return a covariance made symmetric, with a smallest variance in every direction."""
    C = (C + C.T) / 2
    return np.asarray(C + max(SMALLEST_SIGMA_M**2, 1e-9 * np.trace(C)) * np.eye(3))


def jacobian(function: Callable[[Array], Array], n: int) -> Array:
    """Return (len(function), n) central differences at zero."""
    eye = STEP * np.eye(n)
    return np.column_stack([(function(e) - function(-e)) / (2 * STEP) for e in eye])


def block_diagonal(blocks: Sequence[Array]) -> Array:
    sizes = np.cumsum([0, *(len(b) for b in blocks)])
    out = np.zeros((sizes[-1], sizes[-1]))
    for a, b, block in zip(sizes[:-1], sizes[1:], blocks, strict=True):
        out[a:b, a:b] = block
    return out


def moved(pose: UncertainPose, delta: Array) -> tuple[Array, Array]:
    """Return origin (3,) and axes (3, 3) of a pose with error `delta` (6,)."""
    child = pose.parent_from_child
    W, angle = skew(delta[3:]), float(np.linalg.norm(delta[3:]))
    turn = np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * W @ W  # Rodrigues
    return np.asarray(child.translation + delta[:3]), turn @ matrix_of(child)
