"""Shor's relaxation of min z^T Q z over poses, z = (1, vec R, t, -R^T t): its constraints and its solution.

Clarabel (the `certify` extra) solves it.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from hal.arrays import Array
from hal.errors import Unsupported

SIZE = 16
ROTATION, TRANSLATION, BACK = slice(1, 10), slice(10, 13), slice(13, 16)
_UPPER = np.triu_indices(SIZE)
_BY_COLUMN = np.lexsort((_UPPER[0], _UPPER[1]))
_ROWS, _COLUMNS = _UPPER[0][_BY_COLUMN], _UPPER[1][_BY_COLUMN]
_WEIGHT = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(2.0))


@cache
def constraints() -> tuple[Array, Array]:
    """Return the quadratic constraints z^T A_k z = b_k that every pose fulfils: A (K, 16, 16) symmetric, b (K,).

    1 homogenisation, 6 of R^T R = I, 6 of R R^T = I, 9 cross products of columns, 3 of s + R^T t = 0, 3 of t + R s = 0,
    1 of |t| = |s|. (The two orthogonality sets share their trace, so one row of it is left out.)
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
            j, l = (i + 1) % 3, (i + 2) % 3  # noqa: E741 - the indices of the equation
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
    """Return what every problem shares: the constraint columns, the cone and the settings."""
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


def relaxed(Q: Array) -> tuple[Array, float]:
    """Return Z and the minimum of <Q, Z> over Z >= 0 with <A_k, Z> = b_k.

    Solved by its dual: max b.y with Q - sum y_k A_k >= 0.
    """
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


def nearest_pose(z: Array) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and (scaled) translation nearest to the leading eigenvector."""
    z = z / z[0]
    U, _, Vt = np.linalg.svd(z[ROTATION].reshape(3, 3))
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, z[TRANSLATION]
