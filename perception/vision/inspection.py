"""Inspection of a taught panel: register the model to the image, check that every object is present, read each one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.calibration import CameraIntrinsics
from hal.camera_model import check_size, rays
from hal.errors import NotFound
from hal.geometry import UncertainPose, matrix_of
from hal.panel import Panel, PanelObject
from perception.vision.image import as_gray
from perception.vision.noise import noise_sigma
from perception.vision.patch import Patch
from perception.vision.projection import CameraProjection, PanelProjection
from perception.vision.reading import ANSWER_AT, ObjectReading, PatchReading, answer_at, doubted, refused
from perception.vision.registration.outline import contour_m
from perception.vision.registration.register import ObjectFit, Registration, register
from perception.vision.status.reader import patch_of, read_patch, reader_of

MIN_SUPPORT = 0.25  # least share of the model's edges that must be found; with less it is another panel or pose
MIN_EDGE_SHARE = 0.2  # the same for one object
TELLS = 0.9  # confidence from which a reading proves the object although its outline has the plate's gray
NO_OUTLINE = "the object's outline is not where it should be: check the panel file, or something covers it"
MIN_RESOLUTION_PX = 10.0  # smaller objects cannot be read
NO_EDGES = ObjectFit(shift_px=np.zeros(2), shift_sigma_px=0.7, edge_share=float("nan"))
"""The fit of an object whose kind has no edges that every state shows."""
JUMP = 0.25  # largest change since the last reading, relative to the scale, that does not need a confident reading
JUMP_CONFIDENCE = 0.9  # of a reading after a larger change


def inspect(
    image: NDArray[Any],
    intrinsics: CameraIntrinsics,
    camera_from_panel: UncertainPose,
    panel: Panel,
    *,
    names: Iterable[str] | None = None,
    previous: Mapping[str, ObjectReading] | None = None,
    least_confidence: float = ANSWER_AT,
) -> tuple[ObjectReading, ...]:
    """Read every object of a taught panel in one image.

    Args:
        image: (H, W) gray or (H, W, 3) RGB uint8, as the camera recorded it.
        intrinsics: of this camera at this resolution.
        camera_from_panel: pose, good to a few pixels, with its covariance.
        panel: the panel file.
        names: names of the objects to read; all by default.
        previous: last readings by name; an implausible change is answered only if the evidence is strong.
        least_confidence: 0 to 1; less certain readings are refused. Below the default `ANSWER_AT`, guesses are answers.

    Raises:
        InvalidRequest: bad image, calibration of another size, unknown name.
        NotObservable: the image is black or saturated.
        NotFound: the image does not show this panel at this pose.
    """
    gray = as_gray(image)
    check_size(gray, intrinsics)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=camera_from_panel)
    return inspect_view(image, gray, view, panel, names=names, previous=previous, least_confidence=least_confidence)


def inspect_view(
    image: NDArray[Any],
    gray: Image,
    view: PanelProjection,
    panel: Panel,
    *,
    names: Iterable[str] | None = None,
    previous: Mapping[str, ObjectReading] | None = None,
    digits_taught: bool = True,
    least_confidence: float = ANSWER_AT,
) -> tuple[ObjectReading, ...]:
    """Do `inspect` for any view of the panel (see perception.vision.projection).

    `digits_taught`: whether the panel file states the number of digits and decimals of its displays.
    """
    wanted = panel.objects if names is None else tuple(panel.object(name) for name in names)
    registration = register(gray, view, panel)
    if registration.support < MIN_SUPPORT:  # false for NaN, if too few edges are in view to judge the pose
        raise NotFound(
            f"the image does not show panel {panel.name!r} at this pose: {registration.support:.0%} of its edges found",
            hint="find the panel's pose again; check camera calibration, panel file and that the panel is upright",
            support=round(registration.support, 3),
        )
    noise = noise_sigma(gray)
    colour = image if image.ndim == 3 and image.shape[2] >= 3 else None
    readings = [
        _inspect_one(
            gray,
            colour,
            registration,
            panel_object,
            noise=noise,
            before=(previous or {}).get(panel_object.name),
            digits_taught=digits_taught,
        )
        for panel_object in wanted
    ]
    return tuple(answer_at(reading, least_confidence) for reading in readings)


def _inspect_one(
    gray: Image,
    colour: NDArray[Any] | None,
    registration: Registration,
    spec: PanelObject,
    *,
    noise: float,
    before: ObjectReading | None,
    digits_taught: bool,
) -> ObjectReading:
    """Check that one object is present, and read it."""
    view = registration.view
    fit = registration.objects.get(spec.name, NO_EDGES)
    shift = fit.shift_px
    centre_px = view.project([spec.point_m])[0] + shift
    reading = ObjectReading(
        name=spec.name,
        kind=spec.kind,
        present=False,
        centre_px=centre_px,
        outline_px=view.project(contour_m(spec)) + shift,
    )
    reading = _with_place(reading, registration, spec)
    height, width = gray.shape
    if not (np.isfinite(centre_px).all() and -0.5 <= centre_px[0] < width and -0.5 <= centre_px[1] < height):
        return replace(reading, reason="the object is outside the image: move the camera")
    patch = patch_of(gray if colour is None else colour, gray, view, spec, shift)
    patch = replace(patch, is_placed=registration.is_framed)
    if patch.inside.mean() < 0.5:
        return replace(reading, reason="most of the object is outside the image: move the camera")
    if _is_bare(patch, noise):
        return replace(reading, reason="nothing but bare plate where the object should be")
    is_outlined = not fit.edge_share < MIN_EDGE_SHARE
    if not is_outlined and not reader_of(spec.kind).is_telling:
        return replace(reading, reason=NO_OUTLINE)
    if 2 * max(spec.face.half_width_m, spec.face.half_height_m) * patch.image_px_per_m < MIN_RESOLUTION_PX:
        status = refused("the object is too small in this image: come closer")
    else:
        last = None if before is None else before.value
        status = plausible(read_patch(patch, spec, digits_taught=digits_taught, before=last), spec, before)
    if not is_outlined and not (status.answered and status.confidence >= TELLS):
        return replace(reading, reason=NO_OUTLINE)
    return reading.saying(status)


def _is_bare(patch: Patch, noise: float) -> bool:
    """Return whether nothing in the patch stands out from the noise."""
    smooth = cv2.GaussianBlur(patch.gray, (0, 0), 1.5)
    return float(np.percentile(smooth, 97)) - float(np.percentile(smooth, 3)) < 1.5 * noise + 6.0


def plausible(status: PatchReading, spec: PanelObject, before: ObjectReading | None) -> PatchReading:
    """Return the status, or a refusal if it differs much from the previous value without strong evidence."""
    if before is None or before.value is None or status.value is None or status.confidence >= JUMP_CONFIDENCE:
        return status
    if spec.full_scale is None:
        return status
    if abs(status.value - before.value) <= JUMP * spec.full_scale:
        return status
    return doubted(
        status,
        f"{status.value:.4g} is far from the last reading {before.value:.4g} and the evidence is weak: look again",
    )


def _with_place(reading: ObjectReading, registration: Registration, spec: PanelObject) -> ObjectReading:
    """Return the reading with its centre in the panel frame, and the centre's covariance.

    The centre is the intersection of the pixel's ray with the plate.
    """
    view = registration.view
    if not isinstance(view, CameraProjection) or not np.isfinite(reading.centre_px).all():
        return reading
    camera_from_panel = view.camera_from_panel.parent_from_child
    ray = rays(reading.centre_px[None], view.intrinsics)[0]
    R, t = matrix_of(camera_from_panel), camera_from_panel.translation
    normal = R[:, 2]
    facing = float(normal @ ray)
    if not np.isfinite(ray).all() or abs(facing) < 1e-6:
        return reading
    point = R.T @ (ray * (normal @ t) / facing - t)
    J = _plate_jacobian(view, spec.point_m)
    sigma_px = registration.objects.get(spec.name, NO_EDGES).shift_sigma_px
    plate = J @ (np.eye(2) * sigma_px**2) @ J.T
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = plate + np.eye(2) * 1e-12
    covariance[2, 2] = 1e-12  # by definition on the plate
    return replace(reading, centre_m=point, centre_covariance_m2=covariance)


def _plate_jacobian(view: PanelProjection, point_m: tuple[float, float, float]) -> Array:
    """Return the Jacobian (2, 2) of the position on the plate, in metres per pixel, at a panel point."""
    step = 1e-3
    base = np.array(point_m)
    px = view.project(base + step * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    return np.asarray(np.linalg.inv(np.column_stack([px[1] - px[0], px[2] - px[0]]) / step), float)
