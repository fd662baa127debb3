"""From readings and arm poses to one panel pose with an honest covariance.

All readings of one sensor share the error of its mounting. Each measurement carries that error in its weight, as if it
were its own; the covariance of the answer is then summed over the errors that are really independent: each reading's
own, and each mounting's once. One sigma of each is put in, and the answer solved again:
`covariance = sum_k delta_k delta_k^T`, `delta_k` the change of the pose (linear error propagation).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import FusedPose, Measurement, fuse, local_solution, pack, plane, point, sensing
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import undistort_pixels
from hal.geometry import UncertainPose, certain, compose, difference, matrix_of, perturbed
from perception.range import PlaneFit

PLATE = plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), name="plate")


class Evidence(Protocol):
    """One reading, with where the arm stood.

    Attributes:
        sensor: mounted device that gave it.
        base_from_flange: at the time of the reading.
        sigmas: (k,) one sigma of each independent error of the reading itself.
    """

    @property
    def sensor(self) -> str: ...

    @property
    def base_from_flange(self) -> RigidTransform: ...

    @property
    def sigmas(self) -> Array: ...

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """What fusion takes, with `errors` (k,) added to the reading."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightEvidence:
    """A border light seen by the camera. `covariance_px` (2, 2) holds noise, lens and the light's own tolerance."""

    sensor: str
    base_from_flange: RigidTransform
    light: str
    light_m: Array
    pixel_px: Array
    covariance_px: Array
    intrinsics: CameraIntrinsics

    @property
    def sigmas(self) -> Array:
        """Across and along the image, px."""
        return np.full(2, float(np.sqrt(np.trace(self.covariance_px) / 2.0)))

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """The ray through the light: line-point."""
        lens = self.intrinsics
        return sensing.pixel(
            point(self.light_m, name=self.light),
            base_from_sensor,
            pixel_px=undistort_pixels((self.pixel_px + errors)[None], lens)[0],
            sigma_px=float(self.sigmas[0]),
            camera=sensing.Pinhole(fx_px=lens.fx_px, fy_px=lens.fy_px, cx_px=lens.cx_px, cy_px=lens.cy_px),
            label=f"ray to {self.light}",
            sensor=self.sensor,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaneEvidence:
    """The plate's plane in a range image; `systematic_*` is what the scanner's maker allows beyond noise."""

    sensor: str
    base_from_flange: RigidTransform
    fit: PlaneFit
    systematic_offset_m: float = 0.0003
    systematic_angle_rad: float = 0.0005

    @property
    def sigmas(self) -> Array:
        """Offset along the normal (m), then tilt about two axes across it (rad)."""
        feature = self.fit.feature
        offset = np.sqrt(max(0.0, float(feature.direction @ feature.point_covariance @ feature.direction)))
        tilt = np.sqrt(float(np.trace(feature.direction_covariance)) / 2.0)
        angle = float(np.hypot(tilt, self.systematic_angle_rad))
        return np.array([float(np.hypot(offset, self.systematic_offset_m)), angle, angle])

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """The fitted plane: plane-plane."""
        feature = self.fit.feature
        across = np.linalg.svd(feature.direction[None])[2][1:]
        turn = Rotation.from_rotvec(errors[1] * across[0] + errors[2] * across[1])
        return sensing.range_plane(
            PLATE,
            base_from_sensor,
            point_m=feature.point_m + errors[0] * feature.direction,
            normal=turn.apply(feature.direction),
            offset_sigma_m=float(self.sigmas[0]),
            normal_sigma_rad=float(self.sigmas[1]),
            label="plate by range",
            sensor=self.sensor,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TouchEvidence:
    """The finger tip on the bare plate: `tip_m` (3,) in the sensor's frame."""

    sensor: str
    base_from_flange: RigidTransform
    tip_m: Array
    sigma_m: float
    label: str

    @property
    def sigmas(self) -> Array:
        """Along the finger, m: across it nothing is measured."""
        return np.array([self.sigma_m])

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """A point of the plate: point-plane."""
        tip = self.tip_m + np.array([0.0, 0.0, errors[0]])
        return sensing.touch(
            PLATE, base_from_sensor, sigma_m=self.sigma_m, tip_m=tip, label=self.label, sensor=self.sensor
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProximityEvidence:
    """A distance to the bare plate along the sensor's z axis."""

    sensor: str
    base_from_flange: RigidTransform
    distance_m: float
    sigma_m: float
    label: str

    @property
    def sigmas(self) -> Array:
        """Along the beam, m."""
        return np.array([self.sigma_m])

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """A point of the plate: point-plane."""
        return sensing.proximity(
            PLATE,
            base_from_sensor,
            distance_m=self.distance_m + float(errors[0]),
            sigma_m=self.sigma_m,
            lateral_sigma_m=0.002,
            label=self.label,
            sensor=self.sensor,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedEvidence:
    """The panel's pose, the measurements in the order of the evidence, and the fusion's own account."""

    base_from_panel: UncertainPose
    measurements: tuple[Measurement, ...]
    fused: FusedPose


def fuse_evidence(
    evidence: Sequence[Evidence],
    mounts: Mapping[str, UncertainPose],
    *,
    lenses: Mapping[str, Sequence[CameraIntrinsics]] | None = None,
    prior: UncertainPose | None = None,
) -> FusedEvidence:
    """The pose that the evidence points to.

    Args:
        evidence: readings of any sensors.
        mounts: `flange_from_sensor` of every sensor in `evidence`.
        lenses: for each camera, its lens with one independent error one sigma large at a time.
        prior: a pose believed beforehand; it only helps the search and is not part of the answer's covariance.

    Raises:
        InvalidRequest, Contradiction: see `fusion.robust.fuse`.
    """
    measurements = tuple(_measure(e, mounts[e.sensor], np.zeros(len(e.sigmas))) for e in evidence)
    fused = fuse(measurements)
    start = _mirror_resolved(fused, prior)
    rejected = {r.index for r in fused.rejected}
    good = [i for i in range(len(evidence)) if i not in rejected]
    pose = _solve([measurements[i] for i in good], start)
    covariance = np.zeros((6, 6))
    used = [evidence[i] for i in good]
    for changed in (*_one_sigma_changes(used, mounts), *_lens_changes(used, mounts, lenses or {})):
        moved = [changed.get(k, measurements[i]) for k, i in enumerate(good)]
        delta = difference(_solve(moved, pose), pose)
        covariance += np.outer(delta, delta)
    fused = replace(fused, pose=pose)
    return FusedEvidence(
        base_from_panel=UncertainPose(parent_from_child=pose, covariance=covariance),
        measurements=measurements,
        fused=fused,
    )


def _measure(e: Evidence, mount: UncertainPose, errors: Array) -> Measurement:
    return e.measurement(compose(certain(e.base_from_flange), mount), errors)


def _one_sigma_changes(
    evidence: Sequence[Evidence], mounts: Mapping[str, UncertainPose]
) -> list[dict[int, Measurement]]:
    """For each independent error, the measurements that it changes when it is one sigma large."""
    changes: list[dict[int, Measurement]] = []
    for k, e in enumerate(evidence):
        changes += [{k: _measure(e, mounts[e.sensor], error)} for error in np.diag(e.sigmas)]
    nominal = [_measure(e, mounts[e.sensor], np.zeros(len(e.sigmas))) for e in evidence]
    for sensor in sorted({e.sensor for e in evidence}):
        mount = mounts[sensor]
        for error in _one_sigma(mount.covariance):
            wrong = perturbed(mount.parent_from_child, error) * mount.parent_from_child.inv()
            changes.append(
                {
                    k: _carried(nominal[k], e.base_from_flange * wrong * e.base_from_flange.inv())
                    for k, e in enumerate(evidence)
                    if e.sensor == sensor
                }
            )
    return changes


def _lens_changes(
    evidence: Sequence[Evidence], mounts: Mapping[str, UncertainPose], lenses: Mapping[str, Sequence[CameraIntrinsics]]
) -> list[dict[int, Measurement]]:
    """For each independent error of each lens, the rays that it turns."""
    return [
        {
            k: _measure(replace(e, intrinsics=wrong), mounts[e.sensor], np.zeros(2))
            for k, e in enumerate(evidence)
            if isinstance(e, LightEvidence) and e.sensor == camera
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
