"""Pose of the panel from two images of it, with its lights off and on (paper, Section II-B, Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import check_size
from hal.errors import Ambiguous, NotFound
from hal.geometry import UncertainPose, difference, matrix_of, transform
from perception.vision.lights.assign import UPRIGHT, AssignedLights, WrongLamp, assign_lights
from perception.vision.lights.find import LightBlobs, find_lights
from perception.vision.quadrangle import QuadranglePose, estimate
from perception.vision.quadrangle import warm_up as warm_up_quadrangle

MODEL_SIGMA_PX = 0.15  # contribution of a usual lens model to the standard deviation of a light's coordinate
WRONG_FIT_P = 1e-4  # if a worse fit is less probable than this, a lamp, the panel file or the lens is wrong
NEAREST_M = 0.05
# Factor of the largest distance, because the tolerances are per axis and their corners are sqrt(3) times as far.
CORNER = 1.75


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelPrior:
    """Prior knowledge of the panel's pose.

    Attributes:
        camera_from_panel: a rough pose: which way is up, and how far away the panel is.
        camera_from_expected: expected pose, with tolerances on each axis; None if the panel may be anywhere.
    """

    camera_from_panel: RigidTransform
    camera_from_expected: RigidTransform | None = None
    position_tolerance_m: float = np.inf
    angle_tolerance_rad: float = np.inf

    def allows(self, camera_from_panel: RigidTransform) -> bool:
        """Return whether the prior allows the pose."""
        offset = self.offset(camera_from_panel)
        return bool(
            np.linalg.norm(offset[:3]) <= CORNER * self.position_tolerance_m
            and np.linalg.norm(offset[3:]) <= CORNER * self.angle_tolerance_rad
        )

    def offset(self, camera_from_panel: RigidTransform) -> Array:
        """Return the difference (6,) from the expected pose: translation, then rotation."""
        if self.camera_from_expected is None:
            return np.zeros(6)
        return difference(camera_from_panel, self.camera_from_expected)


ANYWHERE = PanelPrior(camera_from_panel=transform(UPRIGHT, (0.0, 0.0, 1.0)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundPanel:
    """The panel found by its lights.

    Attributes:
        camera_from_panel: its pose with the covariance of image noise, lens and lamps.
        lights: which blobs are its lights.
        covariance_px: (4, 2, 2) of each light's pixel, lens and lamps included.
        pose: result of `estimate`: fit, mirror poses, odds.
    """

    camera_from_panel: UncertainPose
    lights: AssignedLights
    covariance_px: Array
    pose: QuadranglePose


def find_panel(
    image_off: NDArray[Any],
    image_on: NDArray[Any],
    lights_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    *,
    prior: PanelPrior = ANYWHERE,
    lens_rms_px: float = MODEL_SIGMA_PX,
    light_sigma_m: float = 0.0,
) -> FoundPanel:
    """Find the panel in one image with its lights off and one with its lights on.

    If the image allows several poses, the one that the prior allows is returned.

    Args:
        image_off, image_on: (H, W) gray or (H, W, 3) RGB, 8 bit, of the size of `intrinsics`.
        lights_m: (4, 3) positions of the lights in the panel's frame, m.
        lens_rms_px: root mean square error of the lens model.
        light_sigma_m: standard deviation of the lamps' positions in the panel.

    Raises:
        CameraMoved: the two images do not show the same view.
        LightMissing: not all four lights are visible.
        WrongLamp: the bright blobs are not arranged like the taught lights.
        NotFound: the pose is not one that the prior allows.
        Ambiguous: two choices of blobs, or two poses, fit equally well.
        InvalidRequest: not images, or of another size than the calibration.
    """
    lights = find_panel_lights(image_off, image_on, lights_m, intrinsics, upright=matrix_of(prior.camera_from_panel))
    distance_m = float(prior.camera_from_panel.translation[2])
    lamp_px = light_sigma_m * intrinsics.fx_px / max(distance_m, NEAREST_M)
    covariance_px = lights.covariance_px + float(np.hypot(lens_rms_px, lamp_px)) ** 2 * np.eye(2)
    pose = estimate(lights_m, lights.points_px, covariance_px, intrinsics)
    if pose.p_value < WRONG_FIT_P:
        raise WrongLamp(
            "four lights were seen, but not where the panel file has them"
            f" (chi-square {pose.chi_square:.0f} on 2 degrees of freedom)",
            hint="check the panel file's light positions, the lens calibration, and for reflections or another lamp",
            chi_square=round(pose.chi_square, 1),
        )
    found = allowed_pose(pose.poses, prior, ambiguous=pose.ambiguous, by="four lights")
    return FoundPanel(camera_from_panel=found, lights=lights, covariance_px=covariance_px, pose=pose)


def find_panel_lights(
    image_off: NDArray[Any],
    image_on: NDArray[Any],
    lights_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    *,
    upright: ArrayLike = UPRIGHT,
) -> AssignedLights:
    """Find the panel's lights, in the order of `lights_m`, without a pose; arguments and errors as `find_panel`.

    Args:
        upright: (3, 3) rough rotation camera_from_panel, see `assign_lights`.
    """
    check_size(np.asarray(image_on), intrinsics)
    size = (intrinsics.width_px, intrinsics.height_px)
    blobs = find_lights(image_off, image_on)
    return assign_lights(blobs, lights_m, image_size_px=size, intrinsics=intrinsics, upright=upright)


def warm_up() -> None:
    """Compile the kernels of `find_panel`, or load them from the cache, so that its first call is fast."""
    warm_up_quadrangle()
    lights = np.array([[-0.2, 0.1, 0.0], [0.2, 0.1, 0.0], [0.2, -0.1, 0.0], [-0.2, -0.1, 0.0]])
    centres = np.array([[120.0, 140.0], [520.0, 140.0], [520.0, 340.0], [120.0, 340.0]])
    one = np.ones(4)
    blobs = LightBlobs(
        centres_px=centres, covariance_px=np.tile(np.eye(2), (4, 1, 1)), area_px=80.0 * one, aspect=one, fill=one,
        contrast=100.0 * one, score=one, threshold=1.0, shift_px=(0.0, 0.0),
    )  # fmt: skip
    assign_lights(blobs, lights, image_size_px=(640, 480))


def allowed_pose(poses: Sequence[UncertainPose], prior: PanelPrior, *, ambiguous: bool, by: str) -> UncertainPose:
    """Return the pose that the prior allows, if there is exactly one.

    Args:
        poses: most likely first; the others count only if the answer is `ambiguous`.
        by: what the panel was found by, for errors.

    Raises:
        NotFound: the prior allows none of them.
        Ambiguous: it allows several.
    """
    candidates = poses if ambiguous and prior.camera_from_expected is not None else poses[:1]
    fitting = [pose for pose in candidates if prior.allows(pose.parent_from_child)]
    if not fitting:
        offset = prior.offset(poses[0].parent_from_child)
        raise NotFound(
            f"the {by} put the panel {np.linalg.norm(offset[:3]):.3f} m and {np.linalg.norm(offset[3:]):.3f} rad from"
            " where the cell file expects it",
            hint="correct workspace.panel_position_m and panel_rpy_rad, or widen their tolerances",
        )
    if len(fitting) > 1:
        raise Ambiguous(
            f"two panel poses fit the {by} equally well",
            hint="look from another side: tilt the camera 15 degrees or come nearer",
        )
    return fitting[0]
