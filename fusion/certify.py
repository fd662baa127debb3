"""A proof that no other pose fits better: the semidefinite relaxation of the fused problem (notes/fusion.md, "Certificate").

With s = -R^T t and z = (1, vec R, t, s), 16 numbers, the rows of `fusion.rows` are linear in z,

    A = a^T m - a^T s - a^T R^T mu      B = n^T (R m + t - mu)      D = n^T R w,

so at frozen covariances E = z^T Q z for any mixture of the nine classes and any number of measurements. Shor's relaxation replaces
z z^T by a positive semidefinite Z under 29 quadratic constraints that every pose obeys. If the best Z has rank one, it is a
pose, and no pose is better. Needs clarabel (the `certify` extra).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.batch import Batch
from fusion.solve import LocalSolution, middle_and_size
from hal.errors import Unsupported
from hal.geometry import Array

SIZE = 16
ROTATION, TRANSLATION, BACK = slice(1, 10), slice(10, 13), slice(13, 16)
TIGHT_GAP = 1e-3
AGREES_SIGMAS = 1.0  # freezing the covariances moves the minimum by a small part of a standard deviation
_UPPER = np.triu_indices(SIZE)
_BY_COLUMN = np.lexsort((_UPPER[0], _UPPER[1]))
_ROWS, _COLUMNS = _UPPER[0][_BY_COLUMN], _UPPER[1][_BY_COLUMN]
_WEIGHT = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(2.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate:
    """What the relaxation says about a pose.

    Attributes:
        tight: the relaxation is a pose, and it is the given one: nothing fits these measurements better.
        gap: ratio of the second to the first eigenvalue of Z; rank one when (almost) zero.
        lower_bound: no pose has a smaller error over these measurements, at the covariances of the answer.
        value: the error of the given pose, at the same covariances.
        distance_sigmas: Mahalanobis distance between the given pose and that of the relaxation.
        base_from_object: the pose of the relaxation.
    """

    tight: bool
    gap: float
    lower_bound: float
    value: float
    distance_sigmas: float
    base_from_object: RigidTransform


def certificate(b: Batch, used: NDArray[np.bool_], local: LocalSolution) -> Certificate:
    """Bound the error of the used entries of `b` (N,) from below, and compare with the solution `local`.

    Raises:
        Unsupported: clarabel is not installed.
    """
    R, t = local.rotation, local.translation_m
    lever, size = middle_and_size(b, used, R)
    about, middle = R.T @ lever, t + lever  # features are taken from `about`, places from `middle`, in units of `size`
    Q = quadratic_form(b, used, R, t, about, middle, size)
    z = _monomials(R, (t + R @ about - middle) / size)
    Z, bound = _relaxed(Q)
    values, vectors = np.linalg.eigh(Z)
    rotation, shift = _pose(vectors[:, -1])
    pose = RigidTransform.from_components(size * shift + middle - rotation.apply(about), rotation)
    turn = (pose.rotation * local.base_from_object.rotation.inv()).as_rotvec()
    delta = np.concatenate([pose.translation - t, turn])
    distance = float(np.sqrt(max(delta @ local.information @ delta, 0.0)))
    gap = float(abs(values[-2]) / values[-1])
    return Certificate(
        tight=gap < TIGHT_GAP and distance < AGREES_SIGMAS,
        gap=gap,
        lower_bound=bound,
        value=float(z @ Q @ z),
        distance_sigmas=distance,
        base_from_object=pose,
    )


def quadratic_form(
    b: Batch, used: NDArray[np.bool_], R: Array, t: Array, about: Array, middle: Array, size: float
) -> Array:
    """Q (16, 16) with z^T Q z = the error of the used entries, their covariances frozen at the pose R, t."""
    Q = np.zeros((SIZE, SIZE))
    for i in map(int, np.flatnonzero(used)):
        rows, V = _prior_rows(b, about, middle, size) if b.cls[i] == 0 else _rows(b, i, R, t, about, middle, size)
        white = np.linalg.solve(np.linalg.cholesky(V), rows)
        Q += white.T @ white
    return Q


def _rows(b: Batch, i: int, R: Array, t: Array, about: Array, middle: Array, size: float) -> tuple[Array, Array]:
    """Rows (k, 16) of entry i over z, and their covariance (k, k) at R, t; the table of notes/fusion.md."""
    c, m, w = b.cls[i], b.m[i] - about, b.w[i]
    mu, C = b.mu[i] - middle, _full(b.C[i])
    d, E = b.d[i], np.column_stack([b.a1[i], b.a2[i]])
    S2 = np.diag(1.0 / np.maximum(b.p[i], 1e-12))
    e, u = R @ b.m[i] + t - b.mu[i], R @ w
    S = E @ S2 @ E.T

    def a_rows(axes: Array) -> Array:
        return np.array([_row_a(a, m, mu, size) for a in axes])

    def b_rows(axes: Array) -> Array:
        return np.array([_row_b(n, m, mu, size) for n in axes])

    def d_rows(axes: Array) -> Array:
        return np.array([_row_d(n, w) for n in axes])

    if c == 1:
        return b_rows(np.eye(3)), C
    if c in (2, 5):
        basis = np.linalg.svd(w[None])[2][1:]
        N = R @ basis.T
        if c == 2:
            return a_rows(basis), N.T @ C @ N
        return np.vstack([a_rows(basis), d_rows(E.T)]), _diagonal(N.T @ C @ N, S2)
    if c == 4:
        return b_rows(E.T), E.T @ C @ E + (d @ e) ** 2 * S2
    if c == 7:
        return b_rows(d[None]), np.array([[d @ C @ d + e @ S @ e]])
    if c == 8:
        V = np.array([[d @ C @ d + e @ S @ e, e @ S @ u], [e @ S @ u, u @ S @ u + 1e-6 * np.trace(S)]])
        return np.vstack([b_rows(d[None]), d_rows(d[None])]), V
    head, first = a_rows(w[None]), np.array([[u @ C @ u]])
    if c == 3:
        return head, first
    if c == 6:
        return np.vstack([head, d_rows(d[None])]), _diagonal(first, np.array([[u @ S @ u + 1e-6 * np.trace(S)]]))
    return np.vstack([head, d_rows(E.T)]), _diagonal(first, S2)


def _row_a(a: Array, m: Array, mu: Array, size: float) -> Array:
    row = np.zeros(SIZE)
    row[0], row[ROTATION], row[BACK] = a @ m, -np.outer(mu, a).ravel(), -size * a
    return row


def _row_b(n: Array, m: Array, mu: Array, size: float) -> Array:
    row = np.zeros(SIZE)
    row[0], row[ROTATION], row[TRANSLATION] = -n @ mu, np.outer(n, m).ravel(), size * n
    return row


def _row_d(n: Array, w: Array) -> Array:
    row = np.zeros(SIZE)
    row[ROTATION] = np.outer(n, w).ravel()
    return row


def _prior_rows(b: Batch, about: Array, middle: Array, size: float) -> tuple[Array, Array]:
    """Rows of a prior pose: t - t0 exactly, and the rotation error as the vector part of R R0^T (first order)."""
    rows = np.zeros((6, SIZE))
    for k in range(3):
        n = np.eye(3)[k]
        rows[k] = _row_b(n, -about, b.prior_t - middle, size)
        # 0.5 sum_j r0_j x r_j = sin(angle) axis; row k of it is 0.5 sum_j (n x r0_j) . r_j
        rows[3 + k, ROTATION] = 0.5 * np.column_stack([np.cross(n, b.prior_r[:, j]) for j in range(3)]).ravel()
    return b.prior_w @ rows, np.eye(6)


def _full(S: Array) -> Array:
    return np.array([[S[0], S[1], S[2]], [S[1], S[3], S[4]], [S[2], S[4], S[5]]])


def _diagonal(A: Array, B: Array) -> Array:
    n, k = len(A), len(B)
    out = np.zeros((n + k, n + k))
    out[:n, :n], out[n:, n:] = A, B
    return out


def _monomials(R: Array, t: Array) -> Array:
    return np.concatenate([[1.0], R.ravel(), t, -R.T @ t])


def _pose(z: Array) -> tuple[Rotation, Array]:
    """Rotation and (scaled) translation nearest to the leading eigenvector."""
    z = z / z[0]
    U, _, Vt = np.linalg.svd(z[ROTATION].reshape(3, 3))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return Rotation.from_matrix(R), z[TRANSLATION]


@cache
def constraints() -> tuple[Array, Array]:
    """The quadratic constraints z^T A_k z = b_k that every pose obeys: A (K, 16, 16) symmetric, b (K,).

    1 homogenisation, 6 of R^T R = I, 6 of R R^T = I, 9 cross products of columns, 3 of s + R^T t = 0, 3 of t + R s = 0, 1 of
    |t| = |s|. (The two orthogonality sets share their trace; one of it is left out.)
    """
    r = [[1 + 3 * i + j for j in range(3)] for i in range(3)]  # places of R_ij, t_i and s_i in z
    t, s = range(10, 13), range(13, 16)
    found: list[tuple[list[tuple[int, int, float]], float]] = [([(0, 0, 1.0)], 1.0)]
    for p in range(3):
        for q in range(p, 3):
            same = [(0, 0, -1.0)] if p == q else []
            found.append(([(r[i][p], r[i][q], 1.0) for i in range(3)] + same, 0.0))
            if (p, q) != (2, 2):
                found.append(([(r[p][i], r[q][i], 1.0) for i in range(3)] + same, 0.0))
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        for i in range(3):
            j, l = (i + 1) % 3, (i + 2) % 3  # noqa: E741
            found.append(([(r[j][p], r[l][q], 1.0), (r[l][p], r[j][q], -1.0), (0, r[i][k], -1.0)], 0.0))
    for k in range(3):
        found.append(([(0, s[k], 1.0)] + [(r[i][k], t[i], 1.0) for i in range(3)], 0.0))
        found.append(([(0, t[k], 1.0)] + [(r[k][i], s[i], 1.0) for i in range(3)], 0.0))
    found.append(([(t[i], t[i], 1.0) for i in range(3)] + [(s[i], s[i], -1.0) for i in range(3)], 0.0))
    A = np.zeros((len(found), SIZE, SIZE))
    for k, (terms, _) in enumerate(found):
        for i, j, value in terms:
            A[k, i, j] += value / 2
            A[k, j, i] += value / 2
    return A, np.array([right for _, right in found])


@cache
def _cone() -> tuple[Any, Any, Any]:
    """What every problem shares: the constraint columns, the cone and the settings."""
    clarabel = _clarabel()
    from scipy.sparse import csc_matrix

    A, _ = constraints()
    columns = csc_matrix((A[:, _ROWS, _COLUMNS] * _WEIGHT).T)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.presolve_enable = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
    return columns, [clarabel.PSDTriangleConeT(SIZE)], settings


def _clarabel() -> Any:
    try:
        import clarabel
    except ImportError:
        raise Unsupported("the certificate needs clarabel", hint="pip install 'panelwright[certify]'") from None
    return clarabel


def _relaxed(Q: Array) -> tuple[Array, float]:
    """min <Q, Z> over Z >= 0 with <A_k, Z> = b_k, by its dual: max b.y with Q - sum y_k A_k >= 0. Returns Z and the minimum."""
    from scipy.sparse import csc_matrix

    columns, cone, settings = _cone()
    _, right = constraints()
    scale = float(np.abs(Q).max())
    target = (Q[_ROWS, _COLUMNS] * _WEIGHT) / scale
    K = len(right)
    solution = _clarabel().DefaultSolver(csc_matrix((K, K)), -right, columns, target, cone, settings).solve()
    Z = np.zeros((SIZE, SIZE))
    Z[_ROWS, _COLUMNS] = np.asarray(solution.z) / _WEIGHT
    return Z + Z.T - np.diag(np.diag(Z)), float(-solution.obj_val * scale)
