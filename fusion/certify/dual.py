"""Multipliers that prove a pose optimal, found from the pose itself: a certificate without a general solver.

The relaxation of `fusion.certify` has the dual: max b.y with S = Q - sum y_k A_k >= 0. If a pose z is optimal and the
relaxation is tight, S z = 0 (complementary slackness). That fixes y up to the combinations of constraints that vanish
at z, and it remains to make S positive definite across z, in 15 dimensions. In the frame of the pose itself, z = (1,
vec I, 0, 0), so those combinations are the same for every problem. Newton's method on -log det S searches among them
until S is positive (Boyd and Vandenberghe, Convex Optimization, 2004, section 11.4: phase one by a barrier). With
enough rows S is positive at once, because y is as small as the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from fusion.certify.relaxation import BACK, ROTATION, SIZE, TRANSLATION, constraints
from hal.arrays import Array
from hal.geometry import skew

GAUSS_NEWTON_STEPS = 20
STILL = 1e-22  # the descent stops when the predicted decrease is a smaller share of the error's scale
BARRIER_STEPS = 25
SLACK = 1e-6  # largest difference between the value and the proven bound, as a share of 1 + value
POSITIVE = 1e-9  # least eigenvalue of the scaled S that counts as positive


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minimiser:
    """A local minimum of z^T Q z over poses.

    Attributes:
        rotation, translation: (3, 3) and (3,), in the units of Q.
        value: z^T Q z there.
        proven: multipliers were found that show it to be the only global minimum.
    """

    rotation: Array
    translation: Array
    value: float
    proven: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Identity:
    """The constraints at z = (1, vec I, 0, 0).

    Attributes:
        z: (16,) the identity pose.
        tangent: (16, 6) derivative of z by a step (translation, rotation).
        across: (16, 15) basis perpendicular to z.
        normals: (16, 29) A_k z.
        normal_fit: (29, 16) gives multipliers from Q z.
        restricted: (29, 15, 15) the constraints across z.
        free: (K, 15, 15) combinations of the constraints that vanish at z.
    """

    z: Array
    tangent: Array
    across: Array
    normals: Array
    normal_fit: Array
    restricted: Array
    free: Array


def minimiser(Q: Array, rotation: Array, translation: Array, *, prove: bool = True) -> Minimiser:
    """Return the minimum of z^T Q z near a pose, and whether it is proven to be the global one.

    Args:
        Q: (16, 16) positive semidefinite, over z = (1, vec R, t, -R^T t).
        rotation, translation: (3, 3), (3,) where to start, in the units of Q.
        prove: also look for multipliers.
    """
    R, t, seen = _descended(Q, rotation, translation)
    at = _identity()
    return Minimiser(rotation=R, translation=t, value=float(at.z @ seen @ at.z), proven=prove and _is_proven(seen))


def _descended(Q: Array, rotation: Array, translation: Array) -> tuple[Array, Array, Array]:
    """Return rotation, translation, and Q in the frame of that pose, by Gauss-Newton (rows are linear in z)."""
    at = _identity()
    R, t = rotation, translation
    scale = float(np.trace(Q))
    for _ in range(GAUSS_NEWTON_STEPS):
        T = seen_from(R, t)
        seen = T.T @ Q @ T
        slope, bend = at.tangent.T @ seen @ at.z, at.tangent.T @ seen @ at.tangent
        step = -np.linalg.solve(bend + (1e-13 * np.trace(bend) + 1e-300) * np.eye(6), slope)
        if -float(slope @ step) < STILL * scale:
            break
        step *= min(1.0, 1.0 / max(float(np.linalg.norm(step[3:])), 1e-12))
        R, t = R @ Rotation.from_rotvec(step[3:]).as_matrix(), t + R @ step[:3]
    return R, t, seen


def seen_from(R: Array, t: Array) -> Array:
    """Return T (16, 16) with z(X1 X) = T z(X) for X1 = (R, t): R1 R, R1 t + t1, s - R^T R1^T t1."""
    T = np.zeros((SIZE, SIZE))
    T[0, 0] = 1.0
    T[ROTATION, ROTATION] = np.kron(R, np.eye(3))
    T[TRANSLATION, 0], T[TRANSLATION, TRANSLATION] = t, R
    T[BACK, BACK], T[BACK, ROTATION] = np.eye(3), -np.kron((R.T @ t)[None], np.eye(3))
    return T


def _is_proven(seen: Array) -> bool:
    """Return whether there are multipliers that make S positive definite across z, with S z = 0."""
    at = _identity()
    force = seen @ at.z
    y = at.normal_fit @ force
    across = at.across.T @ seen @ at.across
    values, vectors = np.linalg.eigh(across)
    white = vectors / np.sqrt(np.maximum(values, 1e-9 * values[-1]))
    S = _made_positive(white.T @ (across - np.tensordot(y, at.restricted, 1)) @ white, white.T @ at.free @ white)
    if S is None:
        return False
    # The residual of S z = 0 lowers the bound; at a minimum it is rounding error.
    left = white.T @ at.across.T @ (force - at.normals @ y)
    return bool(left @ np.linalg.solve(S, left) < SLACK * (1.0 + at.z @ force))


def _made_positive(S: Array, free: Array) -> Array | None:
    """Return S (n, n) + sum x_j free_j (K, n, n) that is positive definite, or None.

    Newton's method on -log det(S + lift I), with a decreasing lift.
    """
    least = float(np.linalg.eigvalsh(S)[0])
    if least > POSITIVE:
        return S
    free = free / np.linalg.norm(free, axis=(1, 2))[:, None, None]
    lift = 1e-3 - least
    for _ in range(BARRIER_STEPS):
        X = np.linalg.inv(S + lift * np.eye(len(S))) @ free
        slope = np.trace(X, axis1=1, axis2=2)
        bend = X.reshape(len(X), -1) @ X.transpose(0, 2, 1).reshape(len(X), -1).T
        x = np.linalg.solve(bend + 1e-10 * np.trace(bend) * np.eye(len(bend)), slope)
        decrement = float(np.sqrt(max(slope @ x, 0.0)))
        S = S + np.tensordot(x / (1.0 + decrement), free, 1)
        least = float(np.linalg.eigvalsh(S)[0])
        if least > POSITIVE:
            return S
        lift = max(0.2 * (lift + least), 1e-12) - least if decrement < 1.0 else lift
    return None


@cache
def _identity() -> _Identity:
    z = np.concatenate([[1.0], np.eye(3).ravel(), np.zeros(6)])
    tangent = np.zeros((SIZE, 6))
    for k in range(3):
        tangent[10 + k, k], tangent[13 + k, k] = 1.0, -1.0
        tangent[ROTATION, 3 + k] = skew(np.eye(3)[k]).ravel()
    across = np.linalg.svd(z[None])[2][1:].T
    A, _ = constraints()
    normals = (A @ z).T
    U, size, Vt = np.linalg.svd(normals)
    rank = int(np.sum(size > 1e-9))
    normal_fit = Vt[:rank].T @ (U[:, :rank] / size[:rank]).T
    restricted = across.T @ A @ across
    kernel = np.tensordot(Vt[rank:], restricted, 1)
    _, kept, combinations = np.linalg.svd(kernel.reshape(len(kernel), -1), full_matrices=False)
    free = combinations[kept > 1e-9].reshape(-1, SIZE - 1, SIZE - 1)
    return _Identity(
        z=z, tangent=tangent, across=across, normals=normals, normal_fit=normal_fit, restricted=restricted, free=free
    )
