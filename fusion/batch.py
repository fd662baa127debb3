"""Checks measurements and lays them out as arrays for the compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from fusion.measurement import NULL_RATIO, Measurement, constraints_of
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose

GATE_PROBABILITY = 0.999  # a good measurement passes its gate with this probability
GATES = np.array([np.inf, *(2.0 * gammaincinv(0.5 * np.arange(1, 7), GATE_PROBABILITY))])  # quantiles of chi-square
FAR_M = 100.0  # no panel is this far away, so a larger number must be in millimetres
WIDE_M = 10.0  # no sensor has a larger standard deviation
SHARP_M = 1e-9  # no sensor has a smaller standard deviation
SHARP_RAD = 1e-9
_DOF = np.array([[6] * 4] + [[constraints_of(c, rank) for rank in range(4)] for c in range(1, 10)])
_FIELDS: tuple[tuple[str, tuple[int, ...]], ...] = (
    ("x_m", (3,)),
    ("u", (3,)),
    ("mu_m", (3,)),
    ("C_m2", (3, 3)),
    ("M", (3, 3)),
)
_AIMLESS = np.isin(np.arange(10), (0, 1, 4, 7))
_UP = np.array([0.0, 0.0, 1.0])
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


class Batch(NamedTuple):
    """Measurements as arrays; symmetric matrices as (xx, xy, xz, yy, yz, zz).

    A prior pose is an additional last entry with cls 0.

    Attributes:
        cls, dof: (N,) class and degrees of freedom.
        m, w: (N, 3) point and direction of the object feature.
        mu: (N, 3) sensed point.
        C: (N, 6) covariance of mu.
        variance, axes: (N, 3) eigenvalues of C in rising order, and (N, 3, 3) unit eigenvectors as rows.
        d, a1, a2: (N, 3) unit eigenvectors of M, its null direction first.
        p: (N, 2) information along a1 and a2, 1/rad^2; 0 where it is only rounding error.
        tilt: (N, 3) all eigenvalues of M unchanged, because even a rounding error of the null one is part of f.
        gate: (N,) chi-square limits.
        prior_r, prior_t: (3, 3), (3,) prior pose.
        prior_w: (6, 6) whitening W of the prior pose, such that |W delta|^2 is chi-square.
    """

    cls: NDArray[np.int64]
    dof: NDArray[np.int64]
    m: Array
    w: Array
    mu: Array
    C: Array
    variance: Array
    axes: Array
    d: Array
    a1: Array
    a2: Array
    p: Array
    tilt: Array
    gate: Array
    prior_r: Array
    prior_t: Array
    prior_w: Array

    def part(self, chosen: NDArray[Any]) -> Batch:
        """Return the entries at the indices (or mask) `chosen`, with the same prior pose."""
        return self._replace(**{k: getattr(self, k)[chosen] for k in self._fields if not k.startswith("prior")})


def pack(measurements: Sequence[Measurement], prior: UncertainPose | None = None) -> Batch:
    """Check measurements and lay them out; the prior, if any, becomes the last entry.

    Raises:
        InvalidRequest: wrong shape, NaN, zero direction, C not positive definite, M indefinite, or numbers that must be
            in another unit; `details` holds `index` and `reason`. Or the prior's covariance is invalid.
    """
    n, extra = len(measurements), int(prior is not None)
    cls = np.array([m.cls for m in measurements] + [0] * extra, np.int64)
    m, u, mu, C, M = (_stacked(measurements, name, shape, extra) for name, shape in _FIELDS)
    if not _plain(m, u, mu, C, M):
        _check_numbers(measurements, m[:n], u[:n], mu[:n], C[:n], M[:n])
        C, M = (C + C.transpose(0, 2, 1)) / 2, (M + M.transpose(0, 2, 1)) / 2
    if extra:
        C[n] = np.eye(3)
    length = np.where(_AIMLESS[cls], 1.0, np.sqrt(np.einsum("ik,ik->i", u, u)))  # a point has no direction
    w = np.where(_AIMLESS[cls][:, None], _UP, u / np.maximum(length, 1e-300)[:, None])
    values, vectors = np.linalg.eigh(np.concatenate([C, M]))
    columns = np.ascontiguousarray(vectors.transpose(0, 2, 1))  # eigenvectors as rows
    variance, values = values[: n + extra], values[n + extra :]
    _check_matrices(measurements, cls[:n], length[:n], variance[:n], values[:n])
    known = np.where(values > NULL_RATIO * np.maximum(values[:, 2:], 1e-300), values, 0.0)
    dof = _DOF[cls, np.count_nonzero(known[:, 1:], axis=1)]
    prior_r, prior_t, prior_w = _prior_arrays(prior)
    return Batch(
        cls=cls, dof=dof, m=m, w=w, mu=mu, C=_sym6(C), variance=variance, axes=columns[: n + extra],
        **{name: np.ascontiguousarray(columns[n + extra :, k]) for k, name in enumerate(("d", "a1", "a2"))},
        p=np.ascontiguousarray(known[:, 1:]), tilt=np.ascontiguousarray(values),
        gate=GATES[dof], prior_r=prior_r, prior_t=prior_t, prior_w=prior_w,
    )  # fmt: skip


def _prior_arrays(prior: UncertainPose | None) -> tuple[Array, Array, Array]:
    """Return rotation, translation and whitening of a prior pose; placeholders when there is none."""
    if prior is None:
        return np.eye(3), np.zeros(3), np.zeros((6, 6))
    # C order and writable like the arrays of the measurements: numba compiles everything again for any other layout.
    pose, white = prior.parent_from_child.as_matrix(), _whitening(prior.covariance)
    return np.array(pose[:3, :3], order="C"), np.array(pose[:3, 3]), np.array(white, order="C")


def duplicates(measurements: Sequence[Measurement]) -> dict[int, int]:
    """Return the index of each measurement that exactly repeats an earlier one, with the index of that one."""
    seen: dict[tuple[object, ...], int] = {}
    found: dict[int, int] = {}
    for i, m in enumerate(measurements):
        key = (int(m.cls), *(np.asarray(a, float).tobytes() for a in (m.x_m, m.u, m.mu_m, m.C_m2, m.M)))
        first = seen.setdefault(key, i)
        if first != i:
            found[i] = first
    return found


def _bad(measurements: Sequence[Measurement], i: int, what: str, hint: str) -> InvalidRequest:
    label = measurements[i].label
    name = f"measurement {i} ({label})" if label else f"measurement {i}"
    return InvalidRequest(f"{name}: {what}", hint=hint, index=i, reason=what)


def _stacked(measurements: Sequence[Measurement], name: str, shape: tuple[int, ...], extra: int) -> Array:
    """Return one field of all measurements, (N + extra, *shape); zero for the prior.

    Raises:
        InvalidRequest: the field of a measurement has another shape.
    """
    given = [getattr(m, name) for m in measurements]
    try:
        found = np.array(given + [np.zeros(shape)] * extra, float)
        if found.shape[1:] == shape:
            return found
    except ValueError:  # of different shapes
        pass
    for i, one in enumerate(given):
        if np.shape(one) != shape:
            raise _bad(measurements, i, f"{name} has shape {np.shape(one)}, not {shape}",
                       "see fusion.measurement.Measurement")  # fmt: skip
    return np.empty((0, *shape))


def _plain(m: Array, u: Array, mu: Array, C: Array, M: Array) -> bool:
    """Return whether all numbers are finite, all points near and all matrices exactly symmetric; a quick check."""
    sizes = (np.abs(m).max(initial=0.0), np.abs(mu).max(initial=0.0), np.abs(u).max(initial=0.0))
    near = sizes[0] <= FAR_M and sizes[1] <= FAR_M and sizes[2] < np.inf  # no comparison holds for NaN
    sums = np.sum(C) + np.sum(M)
    return bool(near and np.isfinite(sums) and (C.transpose(0, 2, 1) == C).all() and (M.transpose(0, 2, 1) == M).all())


def _check_numbers(given: Sequence[Measurement], m: Array, u: Array, mu: Array, C: Array, M: Array) -> None:
    """Refuse numbers that are not finite, not symmetric or not in metres."""
    for (name, _), value in zip(_FIELDS, (m, u, mu, C, M), strict=True):
        _refuse(given, ~_each(np.isfinite(value)), f"{name} holds a number that is not finite",
                "leave out readings that the sensor did not make")  # fmt: skip
    for name, value in (("x_m", m), ("mu_m", mu)):
        _refuse(given, ~_each(np.abs(value) <= FAR_M), f"{name} lies beyond {FAR_M:.0f} m",
                "lengths are in metres, not millimetres")  # fmt: skip
    for name, value in (("C", C), ("M", M)):
        largest = np.abs(value).max(axis=(1, 2), initial=0.0)[:, None, None]
        _refuse(given, ~_each(np.abs(value - value.transpose(0, 2, 1)) <= 1e-6 * largest), f"{name} is not symmetric",
                "C is a covariance in m^2, M an information matrix in 1/rad^2")  # fmt: skip


def _check_matrices(
    given: Sequence[Measurement], cls: NDArray[np.int64], length: Array, variances: NDArray[Any], M: NDArray[Any]
) -> None:
    """Refuse impossible directions and matrices, by the (N, 3) eigenvalues of C and M in rising order."""
    _refuse(given, length < 1e-9, "the object feature's direction is zero", "a line or plane needs a direction")
    _refuse(given, (variances[:, 0] <= 1e-13 * variances[:, 2]) | (variances[:, 2] <= 0), "C is not positive definite",
            "C is a covariance in m^2; nothing is known exactly in any direction")  # fmt: skip
    _refuse(given, (variances[:, 2] > WIDE_M**2) | (variances[:, 2] < SHARP_M**2),
            f"C means a standard deviation beyond {SHARP_M:g} .. {WIDE_M:g} m",
            "C is a covariance in m^2, not in mm^2, and not its inverse")  # fmt: skip
    _refuse(given, M[:, 0] < -1e-6 * np.maximum(np.abs(M[:, 2]), 1e-12), "M is indefinite",
            "M is zero along the measured direction and positive across it")  # fmt: skip
    _refuse(given, M[:, 2] > SHARP_RAD**-2, f"M means a direction better than {SHARP_RAD:g} rad", "M is in 1/rad^2")
    _refuse(given, (cls >= 4) & (M[:, 2] <= 0), "a sensed line or plane needs M", "give M, or declare a sensed point")
    _refuse(given, (cls >= 4) & (M[:, 0] > np.maximum(1e-3 * M[:, 2], 1e-3)), "M has no null direction",
            "M must vanish along the measured direction")  # fmt: skip


def _each(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(holds.all(axis=tuple(range(1, holds.ndim))))


def _refuse(given: Sequence[Measurement], wrong: NDArray[np.bool_], what: str, hint: str) -> None:
    if wrong.any():
        raise _bad(given, int(np.argmax(wrong)), what, hint)


def _sym6(S: NDArray[Any]) -> Array:
    return np.ascontiguousarray(S[:, _UPPER[0], _UPPER[1]])


def _whitening(covariance: Array) -> Array:
    """Return W with W^T W = covariance^-1."""
    if not np.isfinite(covariance).all():
        raise InvalidRequest("the prior pose has a covariance that is not finite", hint="leave the prior out")
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    if values[0] < -1e-9 * max(values[5], 1e-12):
        raise InvalidRequest("the prior pose's covariance is indefinite", hint="check its order and sign")
    # A standard deviation below 1 um or 1 urad is not realistic and would fix the solution.
    return np.asarray(vectors.T / np.sqrt(np.maximum(values, 1e-12))[:, None])
