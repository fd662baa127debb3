"""A sensor's report as eq 13 has it: a squared distance from every candidate feature, tied to one object feature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from fusion.features import Feature, Kind, unit
from hal.errors import InvalidRequest
from hal.geometry import Array, UncertainPose, matrix_of

GATE_PROBABILITY = 0.999  # a good measurement passes its gate with this probability (notes/fusion.md, "Robust")
FAR_M = 100.0  # no panel is this far away: such a number is in millimetres
WIDE_M = 10.0  # no sensor is this poor
NULL_RATIO = 1e-9  # an eigenvalue of M below this share of the largest one is rounding


class SensingClass(IntEnum):
    """What the sensor reports, then what it belongs to on the object (paper, Fig. 11)."""

    POINT_POINT = 1
    POINT_LINE = 2
    POINT_PLANE = 3
    LINE_POINT = 4
    LINE_LINE = 5
    LINE_PLANE = 6
    PLANE_POINT = 7
    PLANE_LINE = 8
    PLANE_PLANE = 9

    @property
    def words(self) -> str:
        """The paper's descriptor, for example `line-point`."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def of(cls, sensed: Kind, on_object: Kind) -> SensingClass:
        """The class of a sensed `point`, `line` or `plane` that belongs to a feature of the object."""
        order = list(Kind)
        return cls(3 * order.index(sensed) + order.index(on_object) + 1)

    @classmethod
    def named(cls, words: str) -> SensingClass:
        """The class with that descriptor; the inverse of `words`.

        Raises:
            InvalidRequest: no such class.
        """
        for member in cls:
            if member.words == words:
                return member
        raise InvalidRequest(f"no sensing class {words!r}", hint=f"one of {[m.words for m in cls]}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """One sensing of one object feature: `g(y, v) = (y - mu)^T C^-1 (y - mu) + v^T M v`, |v| = 1 (eq 13).

    Attributes:
        cls: sensing class.
        x_m: (3,) point of the object feature, object frame, m.
        u: (3,) unit direction or normal of the object feature, object frame; ignored for a point.
        mu_m: (3,) the sensed point, or the place on the sensed line or plane that is known best, base frame, m.
        C_m2: (3, 3) its covariance, m^2; symmetric positive definite.
        M: (3, 3) information of the sensed direction, 1/rad^2; positive semidefinite, its null direction is the measured
            one. Zero when a point was sensed.
        label: how reports call it.
        sensor: which device or sense it came from.
    """

    cls: SensingClass
    x_m: Array
    u: Array
    mu_m: Array
    C_m2: Array
    M: Array
    label: str = ""
    sensor: str = ""

    @property
    def dof(self) -> int:
        """Degrees of freedom of the chi-square that the local pose function follows at the true pose."""
        return _dof(self.cls, int(np.sum(_spectrum(self.M)[0] > 0)))


def measurement(
    feature: Feature,
    sensed: Kind,
    *,
    mu_m: ArrayLike,
    C_m2: ArrayLike,
    M: ArrayLike | None = None,
    label: str = "",
    sensor: str = "",
) -> Measurement:
    """A measurement of `feature` by something that senses points, lines or planes; shapes and units as `Measurement`."""
    return Measurement(
        cls=SensingClass.of(sensed, feature.kind),
        x_m=feature.point_m,
        u=feature.direction,
        mu_m=np.asarray(mu_m, float),
        C_m2=np.asarray(C_m2, float),
        M=np.zeros((3, 3)) if M is None else np.asarray(M, float),
        label=label or f"{sensed}-{feature.kind} {feature.name}".strip(),
        sensor=sensor,
    )


def _dof(cls: int, rank: int) -> int:
    """Unknowns that a class removes when `rank` of the two direction errors are known (notes/fusion.md, table)."""
    rank = min(rank, 2)
    return {1: 3, 2: 2, 3: 1, 4: rank, 5: 2 + rank, 6: 1 + max(rank - 1, 0), 7: max(rank - 1, 0), 8: rank, 9: 1 + rank}[cls]


def _spectrum(M: Array) -> tuple[Array, Array]:
    """The two larger eigenvalues of M (small ones set to zero) and the eigenvectors, null direction first."""
    values, vectors = np.linalg.eigh(M)
    kept = np.where(values[1:] > NULL_RATIO * max(values[2], 1e-300), values[1:], 0.0)
    return kept, vectors


def _bad(i: int, m: Measurement, what: str, hint: str) -> InvalidRequest:
    name = f" ({m.label})" if m.label else ""
    return InvalidRequest(f"measurement {i}{name}: {what}", hint=hint, index=i, reason=what)


def checked(measurements: Sequence[Measurement]) -> list[Measurement]:
    """The same measurements with unit directions and symmetric matrices.

    Raises:
        InvalidRequest: wrong shape, NaN, zero direction, C not positive definite, M indefinite, or numbers that can only
            be in another unit; `details` holds `index` and `reason`.
    """
    return [_checked(i, m) for i, m in enumerate(measurements)]


def _checked(i: int, m: Measurement) -> Measurement:
    for name, value, shape in (
        ("x_m", m.x_m, (3,)), ("u", m.u, (3,)), ("mu_m", m.mu_m, (3,)), ("C_m2", m.C_m2, (3, 3)), ("M", m.M, (3, 3)),
    ):
        if np.shape(value) != shape:
            raise _bad(i, m, f"{name} has shape {np.shape(value)}, not {shape}", "see fusion.measurement.Measurement")
        if not np.isfinite(value).all():
            raise _bad(i, m, f"{name} holds a number that is not finite", "leave out readings that the sensor did not make")
    for name, value in (("x_m", m.x_m), ("mu_m", m.mu_m)):
        if np.abs(value).max() > FAR_M:
            raise _bad(i, m, f"{name} lies beyond {FAR_M:.0f} m", "lengths are in metres, not millimetres")
    C, M = (m.C_m2 + m.C_m2.T) / 2, (m.M + m.M.T) / 2
    if not np.allclose(C, m.C_m2, rtol=1e-6, atol=1e-6 * np.abs(C).max()):
        raise _bad(i, m, "C is not symmetric", "C is a covariance in m^2")
    if not np.allclose(M, m.M, rtol=1e-6, atol=1e-6 * np.abs(M).max()):
        raise _bad(i, m, "M is not symmetric", "M is an information matrix in 1/rad^2")
    variances = np.linalg.eigvalsh(C)
    if variances[0] <= 1e-13 * variances[2] or variances[2] <= 0:
        raise _bad(i, m, "C is not positive definite", "C is a covariance in m^2; no direction is known exactly")
    if variances[2] > WIDE_M**2 or variances[2] < 1e-18:
        raise _bad(i, m, f"C means a sigma of {np.sqrt(variances[2]):.3g} m", "C is in m^2, not mm^2, and not its inverse")
    information = np.linalg.eigvalsh(M)
    if information[0] < -1e-6 * max(abs(information[2]), 1e-12):
        raise _bad(i, m, "M is indefinite", "M is zero along the measured direction and positive across it")
    if information[2] > 1e18:
        raise _bad(i, m, "M means a direction better than 1 nrad", "M is in 1/rad^2")
    u = m.u
    if m.cls not in (1, 4, 7):
        length = float(np.linalg.norm(u))
        if length < 1e-9:
            raise _bad(i, m, "the object feature's direction is zero", "a line or plane needs a direction")
        u = u / length
    if m.cls >= 4 and information[2] <= 0:
        raise _bad(i, m, "a sensed line or plane needs M", "give M, or declare a sensed point")
    if m.cls >= 4 and information[0] > max(1e-3 * information[2], 1e-3):
        raise _bad(i, m, "M has no null direction", "M must vanish along the measured direction")
    return replace(m, u=u, C_m2=C, M=M)


def duplicates(measurements: Sequence[Measurement]) -> dict[int, int]:
    """Index of each measurement that repeats an earlier one number by number, and which one it repeats."""
    seen: dict[tuple[object, ...], int] = {}
    found: dict[int, int] = {}
    for i, m in enumerate(measurements):
        key = (int(m.cls), *(np.asarray(a, float).tobytes() for a in (m.x_m, m.u, m.mu_m, m.C_m2, m.M)))
        if key in seen:
            found[i] = seen[key]
        else:
            seen[key] = i
    return found


class Batch(NamedTuple):
    """Measurements as arrays for the compiled loops; symmetric matrices as (xx, xy, xz, yy, yz, zz).

    cls, dof: (N,) integers; m, w: (N, 3) object point and direction; mu: (N, 3); C, A, M: (N, 6) covariance, its inverse and
    direction information; d, a1, a2: (N, 3) null direction of M and the two others; p: (N, 2) their information,
    1/rad^2; gate: (N,) chi-square limits; prior_*: pose (3, 3), (3,), whitening (6, 6) so that |W delta|^2 is chi-square.

    A prior pose is one more entry with cls 0 at the end.
    """

    cls: np.ndarray[tuple[int], np.dtype[np.int64]]
    dof: np.ndarray[tuple[int], np.dtype[np.int64]]
    m: Array
    w: Array
    mu: Array
    C: Array
    A: Array
    M: Array
    d: Array
    a1: Array
    a2: Array
    p: Array
    gate: Array
    prior_r: Array
    prior_t: Array
    prior_w: Array


_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
GATES = np.array([np.inf, *chi2.ppf(GATE_PROBABILITY, np.arange(1, 7))])


def pack(measurements: Sequence[Measurement], prior: UncertainPose | None = None) -> Batch:
    """Measurements that passed `checked`, as arrays; the prior, if any, becomes the last entry."""
    n = len(measurements) + (prior is not None)
    cls = np.zeros(n, np.int64)
    m, w, mu = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1)), np.zeros((n, 3))
    C, M = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3))
    for i, one in enumerate(measurements):
        cls[i], m[i], mu[i], C[i], M[i] = one.cls, one.x_m, one.mu_m, one.C_m2, one.M
        if one.cls not in (1, 4, 7):
            w[i] = one.u
    values, vectors = np.linalg.eigh(M)
    p = np.where(values[:, 1:] > NULL_RATIO * np.maximum(values[:, 2:], 1e-300), values[:, 1:], 0.0)
    ranks = (p > 0).sum(axis=1)
    dof = np.array([_dof(int(c), int(k)) if c else 6 for c, k in zip(cls, ranks, strict=True)], np.int64)
    prior_r, prior_t, prior_w = np.eye(3), np.zeros(3), np.zeros((6, 6))
    if prior is not None:
        prior_r, prior_t = matrix_of(prior.parent_from_child), np.array(prior.parent_from_child.translation)
        prior_w = _whitening(prior.covariance)
    return Batch(
        cls=cls, dof=dof, m=m, w=w, mu=mu,
        C=_sym6(C), A=_sym6(np.linalg.inv(C)), M=_sym6(M),
        d=np.ascontiguousarray(vectors[:, :, 0]),
        a1=np.ascontiguousarray(vectors[:, :, 1]),
        a2=np.ascontiguousarray(vectors[:, :, 2]),
        p=p, gate=GATES[dof], prior_r=prior_r, prior_t=prior_t, prior_w=prior_w,
    )  # fmt: skip


def _sym6(S: Array) -> Array:
    return np.ascontiguousarray(S[:, _UPPER[0], _UPPER[1]])


def _whitening(covariance: Array) -> Array:
    """W with W^T W = covariance^-1.

    Raises:
        InvalidRequest: the prior's covariance is not positive semidefinite or not finite.
    """
    if not np.isfinite(covariance).all():
        raise InvalidRequest("the prior pose has a covariance that is not finite", hint="leave the prior out")
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    if values[0] < -1e-9 * max(values[5], 1e-12):
        raise InvalidRequest("the prior pose's covariance is indefinite", hint="check its order and sign")
    # A pose known better than 1 um / 1 urad is a claim, not knowledge; it would freeze the solution.
    return np.asarray(vectors.T / np.sqrt(np.maximum(values, 1e-12))[:, None])


def object_directions(m: Measurement) -> Array:
    """(3,) unit direction of the measurement's object feature."""
    return unit(m.u)
