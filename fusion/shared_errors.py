"""Covariance of a pose whose measurements share the errors of their sensors' mountings.

All readings of one sensor share the error of its mounting. Each measurement carries that error in its weight, as if it
were its own; the covariance of the answer is then summed over the errors that are really independent: each reading's
own, and each mounting's once. Each error in turn is set to one sigma and the pose solved again:
`covariance = sum_k delta_k delta_k^T`, `delta_k` the change of the pose (linear error propagation).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.batch import pack
from fusion.measurement import Measurement
from fusion.observations import Observation, PixelObservation
from fusion.robust import FusedPose, fuse
from fusion.solve import local_solution
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.geometry import UncertainPose, certain, compose, difference, matrix_of, perturbed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedObservations:
    """The panel's pose with its covariance, the measurements in the order of the observations, and the fusion's answer.

    The covariance of `base_from_panel` counts shared errors once; that of `fused` takes all measurements as independent.
    """

    base_from_panel: UncertainPose
    measurements: tuple[Measurement, ...]
    fused: FusedPose


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
        lenses: for each camera, its lens with one independent error one sigma large at a time.
        prior: a pose believed beforehand; it only chooses between mirror images and is not part of the answer's covariance.

    Raises:
        InvalidRequest, Contradiction: see `fusion.fuse`.
    """
    measurements = tuple(_measure(o, mounts[o.sensor], np.zeros(len(o.sigmas))) for o in observations)
    fused = fuse(measurements)
    start = _mirror_resolved(fused, prior)
    rejected = {r.index for r in fused.rejected}
    good = [i for i in range(len(observations)) if i not in rejected]
    pose = _solve([measurements[i] for i in good], start)
    covariance = np.zeros((6, 6))
    used = [observations[i] for i in good]
    for changed in (*_one_sigma_changes(used, mounts), *_lens_changes(used, mounts, lenses or {})):
        moved = [changed.get(k, measurements[i]) for k, i in enumerate(good)]
        delta = difference(_solve(moved, pose), pose)
        covariance += np.outer(delta, delta)
    fused = replace(fused, pose=pose)
    return FusedObservations(
        base_from_panel=UncertainPose(parent_from_child=pose, covariance=covariance),
        measurements=measurements,
        fused=fused,
    )


def _measure(o: Observation, mount: UncertainPose, errors: Array) -> Measurement:
    return o.measurement(compose(certain(o.base_from_flange), mount), errors)


def _one_sigma_changes(
    observations: Sequence[Observation], mounts: Mapping[str, UncertainPose]
) -> list[dict[int, Measurement]]:
    """For each independent error, the measurements that it changes when it is one sigma large."""
    changes: list[dict[int, Measurement]] = []
    for k, o in enumerate(observations):
        changes += [{k: _measure(o, mounts[o.sensor], error)} for error in np.diag(o.sigmas)]
    nominal = [_measure(o, mounts[o.sensor], np.zeros(len(o.sigmas))) for o in observations]
    for sensor in sorted({o.sensor for o in observations}):
        mount = mounts[sensor]
        for error in _one_sigma(mount.covariance):
            wrong = perturbed(mount.parent_from_child, error) * mount.parent_from_child.inv()
            changes.append(
                {
                    k: _carried(nominal[k], o.base_from_flange * wrong * o.base_from_flange.inv())
                    for k, o in enumerate(observations)
                    if o.sensor == sensor
                }
            )
    return changes


def _lens_changes(
    observations: Sequence[Observation],
    mounts: Mapping[str, UncertainPose],
    lenses: Mapping[str, Sequence[CameraIntrinsics]],
) -> list[dict[int, Measurement]]:
    """For each independent error of each lens, the rays that it turns."""
    return [
        {
            k: _measure(replace(o, intrinsics=wrong), mounts[o.sensor], np.zeros(2))
            for k, o in enumerate(observations)
            if isinstance(o, PixelObservation) and o.sensor == camera
        }
        for camera, wrong_lenses in lenses.items()
        for wrong in wrong_lenses
    ]


def _carried(m: Measurement, motion: RigidTransform) -> Measurement:
    """The measurement that a sensor would give if it stood moved by `motion` (base frame)."""
    R = matrix_of(motion)
    return replace(m, mu_m=motion.apply(m.mu_m), C_m2=R @ m.C_m2 @ R.T, M=R @ m.M @ R.T)


def _one_sigma(covariance: Array) -> Array:
    """Rows are independent errors of one sigma whose outer products sum to the covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)


def _solve(measurements: Sequence[Measurement], start: RigidTransform) -> RigidTransform:
    batch = pack(measurements)
    return local_solution(
        batch, np.ones(len(measurements)), matrix_of(start), np.asarray(start.translation), far=False
    ).base_from_object


def _mirror_resolved(fused: FusedPose, prior: UncertainPose | None) -> RigidTransform:
    """Of the answer and the alternatives that fit as well, the one nearest to the prior."""
    if prior is None or not fused.is_ambiguous:
        return fused.pose
    poses = [fused.pose, *(a.pose for a in fused.alternatives if a.odds > 0.01)]
    return min(poses, key=lambda pose: float(np.linalg.norm(difference(pose, prior.parent_from_child))))
