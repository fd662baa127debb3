"""Covariance of a pose whose measurements share the errors of their sensors' mountings.

All readings of one sensor share the error of its mounting, and all rays of one camera share that of its lens. For the
weights, each measurement contains the error of the mounting as if it were independent. The covariance of the pose is
then summed over the errors that are really independent. An error of one sigma changes the whitened residuals r by dr,
and so moves the estimate by A^-1 g with g = J^T dr and A = J^T J (linear error propagation):

    covariance = A^-1 (sum_k g_k g_k^T) A^-1
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.batch import pack
from fusion.distance.rows import whitened_all
from fusion.measurement import Measurement
from fusion.observations import Observation, PixelObservation
from fusion.robust import FusedPose, fuse
from fusion.solve import local_solution
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.geometry import UncertainPose, certain, compose, difference, matrix_of, perturbed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ErrorBudget:
    """The information of a set of observations about a pose, and every independent error in it.

    Attributes:
        information: (6, 6) A = sum of J^T J, translation then rotation, base axes.
        own: (6, 6) sum of g g^T over the errors that belong to one reading each.
        shared: for every mounting and lens, (6, k) the g of each of its errors.
    """

    information: Array
    own: Array
    shared: Mapping[str, Array]

    def plus(self, other: ErrorBudget) -> ErrorBudget:
        """Return the budget of both sets of observations together."""
        names = sorted({*self.shared, *other.shared})
        return ErrorBudget(
            information=self.information + other.information,
            own=self.own + other.own,
            shared={name: np.asarray(self.shared.get(name, 0.0) + other.shared.get(name, 0.0)) for name in names},
        )

    @property
    def covariance(self) -> Array:
        """(6, 6) of the pose: the true one has translation t + d and rotation Exp(r) R, base axes."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.information), 1e-300))  # scales metres and radians alike
        inverse = np.linalg.inv(self.information * np.outer(scale, scale)) * np.outer(scale, scale)
        spread = self.own + sum((G @ G.T for G in self.shared.values()), np.zeros((6, 6)))
        return np.asarray(inverse @ spread @ inverse)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedObservations:
    """The panel's pose with its covariance, the measurements in the order of observations, and the result of `fuse`.

    The covariance of `base_from_panel` counts shared errors once; that of `fused` takes all measurements as
    independent.
    """

    base_from_panel: UncertainPose
    measurements: tuple[Measurement, ...]
    fused: FusedPose
    budget: ErrorBudget


def fuse_observations(
    observations: Sequence[Observation],
    mounts: Mapping[str, UncertainPose],
    *,
    lenses: Mapping[str, Sequence[CameraIntrinsics]] | None = None,
    prior: UncertainPose | None = None,
) -> FusedObservations:
    """Fuse readings of mounted sensors into the pose of the panel.

    Args:
        observations: readings of any sensors.
        mounts: `flange_from_sensor` of every sensor in `observations`.
        lenses: for each camera, its calibrations, each with one independent error of one sigma.
        prior: a prior pose; it only chooses between mirror images and does not enter the resulting covariance.

    Raises:
        InvalidRequest, Contradiction: see `fusion.fuse`.
    """
    measurements = tuple(_measure(o, mounts[o.sensor], np.zeros(len(o.sigmas))) for o in observations)
    fused = fuse(measurements)
    start = _mirror_resolved(fused, prior)
    rejected = {r.index for r in fused.rejected}
    good = [i for i in range(len(observations)) if i not in rejected]
    pose = _solve([measurements[i] for i in good], start)
    budget = error_budget([observations[i] for i in good], mounts, pose, lenses=lenses)
    covariance = fused.covariance if fused.unobservable else budget.covariance
    return FusedObservations(
        base_from_panel=UncertainPose(parent_from_child=pose, covariance=covariance),
        measurements=measurements,
        fused=replace(fused, pose=pose),
        budget=budget,
    )


def error_budget(
    observations: Sequence[Observation],
    mounts: Mapping[str, UncertainPose],
    base_from_panel: RigidTransform,
    *,
    lenses: Mapping[str, Sequence[CameraIntrinsics]] | None = None,
) -> ErrorBudget:
    """Return the information of observations and the errors that they share; arguments as `fuse_observations`.

    It depends on the poses of the sensors and hardly on their readings, so it also holds for expected readings.
    """
    nominal = [_measure(o, mounts[o.sensor], np.zeros(len(o.sigmas))) for o in observations]
    own = [{i: _measure(o, mounts[o.sensor], error)} for i, o in enumerate(observations) for error in np.diag(o.sigmas)]
    shared = {
        **_mounting_errors(observations, mounts, nominal),
        **_lens_errors(observations, mounts, lenses or {}),
    }
    changes = [*own, *(change for errors in shared.values() for change in errors)]
    informations, gradients = linearised(
        [*nominal, *(m for change in changes for m in change.values())], base_from_panel
    )
    concerned = [(k, i) for k, change in enumerate(changes) for i in change]
    g = np.zeros((len(changes), 6))
    for n, (k, i) in enumerate(concerned, len(nominal)):
        g[k] += gradients[n] - gradients[i]
    ends = np.cumsum([len(own), *(len(errors) for errors in shared.values())])
    return ErrorBudget(
        information=informations[: len(nominal)].sum(axis=0),
        own=g[: len(own)].T @ g[: len(own)],
        shared={name: g[a:b].T for name, a, b in zip(shared, ends[:-1], ends[1:], strict=True)},
    )


def _measure(o: Observation, mount: UncertainPose, errors: Array) -> Measurement:
    return o.measurement(compose(certain(o.base_from_flange), mount), errors)


Change = dict[int, Measurement]
"""The measurements that an error affects, changed by it, by their index."""


def _mounting_errors(
    observations: Sequence[Observation], mounts: Mapping[str, UncertainPose], nominal: Sequence[Measurement]
) -> dict[str, list[Change]]:
    """Return for each sensor its measurements when one independent error of its mounting is one sigma."""
    errors: dict[str, list[Change]] = {}
    for sensor in sorted({o.sensor for o in observations}):
        mount = mounts[sensor]
        wrong = [perturbed(mount.parent_from_child, error) for error in _one_sigma(mount.covariance)]
        errors[f"mounting of {sensor}"] = [
            {
                i: _carried(
                    nominal[i], o.base_from_flange * pose * (o.base_from_flange * mount.parent_from_child).inv()
                )
                for i, o in enumerate(observations)
                if o.sensor == sensor
            }
            for pose in wrong
        ]
    return errors


def _lens_errors(
    observations: Sequence[Observation],
    mounts: Mapping[str, UncertainPose],
    lenses: Mapping[str, Sequence[CameraIntrinsics]],
) -> dict[str, list[Change]]:
    """Return for each camera its rays when one independent error of its lens is one sigma."""
    return {
        f"lens of {camera}": [
            {
                i: _measure(replace(o, intrinsics=wrong), mounts[o.sensor], np.zeros(2))
                for i, o in enumerate(observations)
                if isinstance(o, PixelObservation) and o.sensor == camera
            }
            for wrong in wrong_lenses
        ]
        for camera, wrong_lenses in lenses.items()
    }


def linearised(measurements: Sequence[Measurement], pose: RigidTransform) -> tuple[Array, Array]:
    """Return J^T J (N, 6, 6) and J^T r (N, 6) of each measurement at a pose."""
    R, t = np.array(matrix_of(pose), order="C"), np.array(pose.translation, order="C")
    r, J = np.zeros((len(measurements), 6)), np.zeros((len(measurements), 6, 6))
    whitened_all(pack(measurements), R, t, r, J)
    return np.einsum("nki,nkj->nij", J, J), np.einsum("nki,nk->ni", J, r)


def _carried(m: Measurement, motion: RigidTransform) -> Measurement:
    """Return the measurement that a sensor would give if it were moved by `motion` (base frame)."""
    R = matrix_of(motion)
    return replace(m, mu_m=motion.apply(m.mu_m), C_m2=R @ m.C_m2 @ R.T, M=R @ m.M @ R.T)


def _one_sigma(covariance: Array) -> Array:
    """Return rows that are independent errors of one sigma, whose outer products sum to the covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)


def _solve(measurements: Sequence[Measurement], start: RigidTransform) -> RigidTransform:
    batch = pack(measurements)
    return local_solution(
        batch, np.ones(len(measurements)), matrix_of(start), np.asarray(start.translation), far=False
    ).base_from_object


def _mirror_resolved(fused: FusedPose, prior: UncertainPose | None) -> RigidTransform:
    """Return the pose nearest to the prior, of the answer and the alternatives that fit as well."""
    if prior is None or not fused.is_ambiguous:
        return fused.pose
    poses = [fused.pose, *(a.pose for a in fused.alternatives if a.odds > 0.01)]
    return min(poses, key=lambda pose: float(np.linalg.norm(difference(pose, prior.parent_from_child))))
