"""From two images of the panel, lights off and on, to the panel's pose (paper, Section II-B, Fig. 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.calibration import CameraIntrinsics
from hal.camera_model import check_size
from perception.vision.lights.assign import UPRIGHT, AssignedLights, WrongLamp, assign_lights
from perception.vision.lights.find import LightBlobs, find_lights
from perception.vision.quadrangle import QuadranglePose, estimate
from perception.vision.quadrangle import warm_up as warm_up_quadrangle

MODEL_SIGMA_PX = 0.15  # what the lens model and the lamps' own centres add to each coordinate of a light
LEAST_P_VALUE = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelView:
    """The panel seen once: its pose, the lights that gave it, and every blob that was considered."""

    pose: QuadranglePose
    lights: AssignedLights
    blobs: LightBlobs


def warm_up() -> None:
    """Compile (or load from the cache) what `panel_pose` needs, so that the first real call is as fast as any."""
    warm_up_quadrangle()
    lights = np.array([[-0.2, 0.1, 0.0], [0.2, 0.1, 0.0], [0.2, -0.1, 0.0], [-0.2, -0.1, 0.0]])
    centres = np.array([[120.0, 140.0], [520.0, 140.0], [520.0, 340.0], [120.0, 340.0]])
    one = np.ones(4)
    blobs = LightBlobs(
        centres_px=centres, covariance_px=np.tile(np.eye(2), (4, 1, 1)), area_px=80.0 * one, aspect=one, fill=one,
        contrast=100.0 * one, score=one, threshold=1.0, shift_px=(0.0, 0.0),
    )  # fmt: skip
    assign_lights(blobs, lights, image_size_px=(640, 480))


def panel_pose(
    image_off: NDArray[Any],
    image_on: NDArray[Any],
    lights_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    *,
    upright: ArrayLike = UPRIGHT,
    model_sigma_px: float = MODEL_SIGMA_PX,
) -> PanelView:
    """Where the panel stands in camera axes, from one image with its lights off and one with its lights on.

    Args:
        image_off, image_on: (H, W) gray or (H, W, 3) RGB, 8 bit, of the size that `intrinsics` names.
        lights_m: (4, 3) places of the lights in the panel's frame, m.
        upright: (3, 3) rough rotation camera_from_panel, see `assign_lights`.
        model_sigma_px: what lens model and lamps add to the noise of each coordinate.

    Raises:
        CameraMoved: the two images do not show the same view.
        LightMissing: not all four lights are seen.
        WrongLamp: the bright blobs do not stand as the taught lights.
        Ambiguous: two choices of blobs fit equally well.
        InvalidRequest: not images, or another size than the calibration.
    """
    check_size(np.asarray(image_on), intrinsics)
    blobs = find_lights(image_off, image_on)
    size = (intrinsics.width_px, intrinsics.height_px)
    lights = assign_lights(blobs, lights_m, image_size_px=size, intrinsics=intrinsics, upright=upright)
    covariance = lights.covariance_px + model_sigma_px**2 * np.eye(2)
    pose = estimate(lights_m, lights.points_px, covariance, intrinsics)
    if pose.p_value < LEAST_P_VALUE:
        raise WrongLamp(
            f"the four lamps fit the taught lights badly (chi-square {pose.chi_square:.0f} on 2 degrees of freedom)",
            hint="check the panel file's lights and the camera calibration, and that no other lamp was switched",
            chi_square=round(pose.chi_square, 1),
        )
    return PanelView(pose=pose, lights=lights, blobs=blobs)
