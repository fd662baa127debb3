"""Points in space from two or more views of cameras on the arm, and their depth before the panel."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from fusion.features import Feature, Kind
from fusion.measurement import Measurement, measurement
from fusion.observations import PixelObservation
from fusion.sensing.propagation import block_diagonal, floored
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import normalised_with_jacobian
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose, matrix_of, skew

LEAST_PARALLAX_RAD = 0.05  # at 0.3 m and with 1 px of error the depth is then known to 18 mm
DISAGREE_P = 1e-6  # chance that views of one point disagree so much
CONTRADICT_P = 1e-4
STEPS = 15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriangulatedPoint:
    """A point that several views see.

    Attributes:
        point_m: (3,) base frame.
        covariance: (3, 3) of it, m^2, with the errors that its views share.
        chi_square, degrees: how well the views agree, and the degrees of freedom, 2 per view less 3.
        parallax_rad: largest angle between two rays.
    """

    point_m: Array
    covariance: Array
    chi_square: float
    degrees: int
    parallax_rad: float

    def measurement(self, feature: Feature, *, label: str = "", sensor: str = "camera") -> Measurement:
        """Return the measurement of `feature` (object frame) by this point, for a point of class point-point."""
        return measurement(
            feature, Kind.POINT, mu_m=self.point_m, C_m2=floored(self.covariance), label=label, sensor=sensor
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelDepth:
    """Height of a point above the plate, along the panel's normal, beside the height that was expected.

    Attributes:
        sigma_m: one standard deviation of `depth_m`, with the error of the panel's pose.
        chi_square: of the difference, on one degree of freedom.
    """

    depth_m: float
    sigma_m: float
    expected_m: float
    chi_square: float

    @property
    def contradicts(self) -> bool:
        """Whether the difference would arise by chance in less than one case of 10,000."""
        return bool(chdtrc(1, self.chi_square) < CONTRADICT_P)


def triangulate(
    seen: Sequence[PixelObservation],
    mounts: Mapping[str, UncertainPose],
    *,
    lenses: Mapping[str, Sequence[CameraIntrinsics]] | None = None,
) -> TriangulatedPoint:
    """Return the point that all views see: it minimises e^T S^-1 e over the errors e in all images together.

    S holds the covariance of each pixel, and c c^T for every error that views share: each independent error of the
    mounting of a camera and of its lens, one sigma large, changes e by c.

    Args:
        seen: two views or more of one point; `point_m` and `name` are not used.
        mounts: `flange_from_sensor` of each camera.
        lenses: for each camera, its calibrations, each with one independent error of one sigma.

    Raises:
        InvalidRequest: fewer than two views, or a pixel that is not finite or outside the lens.
        NotObservable: the rays are nearly parallel, so that the depth stays free.
        NotFound: the rays do not meet, so that different things were seen.
    """
    if len(seen) < 2:
        raise InvalidRequest("a point needs two views", hint="look from a second wrist pose")
    views = [_View(one, mounts[one.sensor]) for one in seen]
    rays = np.array([view.ray for view in views])
    parallax = float(np.arcsin(np.clip(np.linalg.norm(np.cross(rays[:, None], rays), axis=2), 0.0, 1.0)).max())
    if parallax < LEAST_PARALLAX_RAD:
        raise NotObservable(
            f"the rays differ by only {1e3 * parallax:.0f} mrad, so that the depth stays free",
            hint="move the wrist sideways by a tenth of the distance or more",
        )
    point = _nearest_to(rays, np.array([view.centre_m for view in views]))
    weight = np.linalg.inv(_covariance(views, point, mounts, lenses or {}))
    for _ in range(STEPS):
        e, J = _errors(views, point)
        information = J.T @ weight @ J
        step = np.linalg.solve(information, J.T @ weight @ e)
        point = point - step
        if float(step @ information @ step) < 1e-12:
            break
    e, _ = _errors(views, point)
    chi_square, degrees = float(e @ weight @ e), 2 * len(seen) - 3
    if chdtrc(degrees, chi_square) < DISAGREE_P:
        raise NotFound(
            f"the views do not see one point (chi-square {chi_square:.0f} on {degrees} degrees of freedom)",
            hint="check that the same thing was found in every view, and the calibration of the camera's mount",
        )
    return TriangulatedPoint(
        point_m=point,
        covariance=np.asarray(np.linalg.inv(information), float),
        chi_square=chi_square,
        degrees=degrees,
        parallax_rad=parallax,
    )


def depth_before(
    base_from_panel: UncertainPose, point: TriangulatedPoint, *, expected_m: float, expected_sigma_m: float = 0.0
) -> PanelDepth:
    """Compare a point's height above the plate with the expected one; the errors of pose and point count as independent."""
    pose = base_from_panel.parent_from_child
    normal, away = matrix_of(pose)[:, 2], point.point_m - pose.translation
    by_pose = np.concatenate([-normal, np.cross(normal, away)])  # a turn r moves the normal by r x n
    variance = float(normal @ point.covariance @ normal + by_pose @ base_from_panel.covariance @ by_pose)
    depth_m = float(normal @ away)
    return PanelDepth(
        depth_m=depth_m,
        sigma_m=float(np.sqrt(variance)),
        expected_m=expected_m,
        chi_square=(depth_m - expected_m) ** 2 / (variance + expected_sigma_m**2),
    )


def with_common_errors(seen: Sequence[PixelObservation], common_px: Sequence[Array]) -> tuple[PixelObservation, ...]:
    """Return the views with the errors that all views of the same point share, so that a pose may be fused from them.

    Of n views each takes n times the covariance of the common error, and their mean that of the error itself.

    Args:
        common_px: for each view the (2, 2) covariance of the common error in it, px^2.
    """
    count = Counter(one.name for one in seen)
    return tuple(
        replace(one, covariance_px=one.covariance_px + count[one.name] * common)
        for one, common in zip(seen, common_px, strict=True)
    )


class _View:
    """One camera that sees the point: where it stands, and the ideal image point."""

    def __init__(self, seen: PixelObservation, mount: UncertainPose) -> None:
        self.seen = seen
        self.base_from_camera = seen.base_from_flange * mount.parent_from_child
        self.centre_m = np.asarray(self.base_from_camera.translation)
        self.R = matrix_of(self.base_from_camera)
        self.ideal, by_pixel = self._ideal(seen.intrinsics)
        self.covariance = by_pixel @ seen.covariance_px @ by_pixel.T
        ray = self.R @ [*self.ideal, 1.0]
        self.ray = ray / np.linalg.norm(ray)

    def _ideal(self, intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
        ideal, by_pixel = normalised_with_jacobian(np.atleast_2d(self.seen.pixel_px), intrinsics)
        if not np.isfinite(ideal).all():
            raise InvalidRequest(
                f"the pixel of {self.seen.name} is not finite or outside the lens", hint="check pixel and calibration"
            )
        return ideal[0], by_pixel[0]

    def error(self, point_m: Array) -> tuple[Array, Array]:
        """Return the error in ideal image coordinates (2,) and its derivative by the point (2, 3)."""
        x, y, z = self.R.T @ (point_m - self.centre_m)
        if z <= 0.0:
            raise NotFound("the rays meet behind a camera", hint="check that all views show the same thing")
        by_camera = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
        return np.array([x, y]) / z - self.ideal, by_camera @ self.R.T

    def change_by_mount(self, point_m: Array, delta: Array) -> Array:
        """Return the change (2,) of the error by a small error (6,) of the mount, flange axes."""
        turned = matrix_of(self.seen.base_from_flange)
        shift, turn = turned @ delta[:3], turned @ delta[3:]
        _, J = self.error(point_m)
        return np.asarray(-J @ (shift + skew(turn) @ (point_m - self.centre_m)))

    def change_by_lens(self, wrong: CameraIntrinsics) -> Array:
        """Return the change (2,) of the error when the lens is `wrong`."""
        return np.asarray(self.ideal - self._ideal(wrong)[0])


def _nearest_to(rays: Array, centres_m: Array) -> Array:
    """Return the point nearest to all rays: sum (I - r r^T) (p - c) = 0."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres_m))


def _errors(views: Sequence[_View], point_m: Array) -> tuple[Array, Array]:
    """Return the errors of N views (2 N,) and their derivatives by the point (2 N, 3)."""
    errors = [view.error(point_m) for view in views]
    return np.concatenate([e for e, _ in errors]), np.vstack([J for _, J in errors])


def _covariance(
    views: Sequence[_View],
    point_m: Array,
    mounts: Mapping[str, UncertainPose],
    lenses: Mapping[str, Sequence[CameraIntrinsics]],
) -> Array:
    """Return the covariance (2 N, 2 N) of the errors of all views."""
    S = np.array(block_diagonal([view.covariance for view in views]))
    for sensor in sorted({view.seen.sensor for view in views}):
        values, vectors = np.linalg.eigh(mounts[sensor].covariance)
        shared = [
            [view.change_by_mount(point_m, delta) for view in views if view.seen.sensor == sensor]
            for delta in (vectors * np.sqrt(np.maximum(values, 0.0))).T
        ]
        shared += [
            [view.change_by_lens(wrong) for view in views if view.seen.sensor == sensor]
            for wrong in lenses.get(sensor, ())
        ]
        own = np.repeat([view.seen.sensor == sensor for view in views], 2)
        C = np.array([np.concatenate(changes) for changes in shared]).T
        S[np.ix_(own, own)] += C @ C.T
    return S
