"""The taught panel: register the model to the image, check that every object is there, read each one."""

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
from hal.panel import Display, Panel, PanelObject, Scale
from perception.vision.image import as_gray
from perception.vision.noise import noise_sigma
from perception.vision.patch import Patch, rectify
from perception.vision.projection import CameraProjection, PanelProjection
from perception.vision.reading import (
    ANSWER_AT,
    ObjectReading,
    PatchReading,
    answer_at,
    as_often_right,
    doubted,
    refused,
)
from perception.vision.registration.outline import contour_m, footprint_m
from perception.vision.registration.register import Registration, register
from perception.vision.status.button import read_button
from perception.vision.status.display import read_display
from perception.vision.status.gauge import read_gauge
from perception.vision.status.handwheel import read_handwheel
from perception.vision.status.lamp import read_lamp
from perception.vision.status.lever import read_lever
from perception.vision.status.mushroom import read_mushroom
from perception.vision.status.panel_meter import read_panel_meter
from perception.vision.status.rotary import read_rotary
from perception.vision.status.slider import read_slider
from perception.vision.status.toggle import read_toggle

MARGIN = 1.25  # of the footprint: readers look at the plate around the object too
LAMP_MARGIN = 2.0
MIN_SUPPORT = 0.25  # share of the model's edges that must be found for the panel to be this one
MIN_EDGE_SHARE = 0.2  # the same for one object
# Kinds whose reading, when sure, is proof of the object where its outline has the plate's gray, and from which confidence on.
TELLING, TELLS = frozenset({"gauge", "panel_meter", "display", "rotary"}), 0.9
NO_OUTLINE = "the object's outline is not where it should be: check the panel file, or something covers it"
MIN_RESOLUTION_PX = 10.0  # smaller objects cannot be read
# Share of a kind's guesses that are right however weak the evidence, but no more than a guess may claim (of 8218 objects on 800
# drawn hard panels): of two states one is right soon, of many numbers none.
GUESSES_RIGHT = {
    "toggle": 0.45, "lever": 0.45, "button": 0.42, "lamp": 0.4, "rotary": 0.4, "handwheel": 0.38, "slider": 0.38,
    "display": 0.06,
}  # fmt: skip
JUMP = 0.25  # of the scale: a larger change since the last reading needs a confident reading
JUMP_CONFIDENCE = 0.9


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
    """Every object of a taught panel as one image shows it.

    Args:
        image: (H, W) gray or (H, W, 3) RGB uint8, as the camera gave it.
        intrinsics: of this camera at this resolution.
        camera_from_panel: pose, good to a few pixels, with its covariance.
        panel: the panel file.
        names: objects wanted; all by default.
        previous: last readings by name: an implausible jump is answered only when the evidence is strong.
        least_confidence: 0 to 1; less sure readings are refused. Below `ANSWER_AT`, the default, best guesses are answers.

    Raises:
        InvalidRequest: bad image, calibration of another size, unknown name.
        NotObservable: the image shows nothing.
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
    """`inspect` for any view of the panel (see perception.vision.projection).

    `digits_taught` False: the panel file does not know how many digits and decimals its displays have.
    """
    wanted = panel.objects if names is None else tuple(panel.object(name) for name in names)
    registration = register(gray, view, panel)
    if registration.support < MIN_SUPPORT:  # NaN: too few edges in view to doubt the pose
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


def read_patch(
    patch: Patch, spec: PanelObject, *, digits_taught: bool = True, before: float | None = None
) -> PatchReading:
    """The status of one object by the reader of its kind; the value `before` tells between a display's likely numbers."""
    status = _by_kind(patch, spec, digits_taught=digits_taught, before=before)
    return as_often_right(status, GUESSES_RIGHT.get(spec.kind, 0.0))


def _by_kind(patch: Patch, spec: PanelObject, *, digits_taught: bool, before: float | None) -> PatchReading:
    match spec.kind:
        case "gauge":
            return read_gauge(patch, spec)
        case "panel_meter":
            return read_panel_meter(patch, spec)
        case "display":
            return read_display(patch, spec, digits_taught=digits_taught, before=before)
        case "lamp":
            return read_lamp(patch, spec)
        case "button":
            return read_button(patch, spec)
        case "toggle":
            return read_toggle(patch, spec)
        case "rotary":
            return read_rotary(patch, spec)
        case "slider":
            return read_slider(patch, spec)
        case "lever":
            return read_lever(patch, spec)
        case "handwheel":
            return read_handwheel(patch, spec)
        case "mushroom":
            return read_mushroom(patch, spec)


def patch_of(image: Image, gray: Image, view: PanelProjection, spec: PanelObject, shift_px: Array) -> Patch:
    """The rectified patch that the reader of this object wants."""
    half_width, half_height, height = footprint_m(spec)
    margin = LAMP_MARGIN if spec.kind in ("lamp", "button") else MARGIN
    plane = 0.0 if spec.kind == "toggle" else height
    # What stands out appears beside its foot: the patch must hold both.
    side = 0.012 if spec.kind == "slider" else 0.003
    if spec.kind == "toggle":  # and the plate beyond its tip, where it must have ended
        side += _lean_m(view, spec, height) + 2.0 * spec.bat_radius_m
    return rectify(
        image,
        view,
        spec.position_m,
        half_width_m=margin * half_width + side,
        half_height_m=margin * half_height + side,
        plane_z_m=plane,
        shift_px=shift_px,
        gray=gray,
    )


def _lean_m(view: PanelProjection, spec: PanelObject, height_m: float) -> float:
    """How far beside its foot a point at that height appears, in metres on the plate."""
    x, y = spec.position_m
    px = view.project([[x, y, 0.0], [x, y, height_m], [x + 0.01, y, 0.0], [x, y + 0.01, 0.0]])
    scale = min(float(np.linalg.norm(px[2] - px[0])), float(np.linalg.norm(px[3] - px[0]))) / 0.01
    return float(np.linalg.norm(px[1] - px[0])) / max(scale, 1e-9)


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
    view = registration.view
    shift = registration.shift_px.get(spec.name, np.zeros(2))
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
    if patch.inside.mean() < 0.5:
        return replace(reading, reason="most of the object is outside the image: move the camera")
    if _is_bare(patch, noise):
        return replace(reading, reason="nothing but bare plate where the object should be")
    is_outlined = not registration.edge_share.get(spec.name, float("nan")) < MIN_EDGE_SHARE
    if not is_outlined and spec.kind not in TELLING:
        return replace(reading, reason=NO_OUTLINE)
    if 2 * max(footprint_m(spec)[:2]) * patch.image_px_per_m < MIN_RESOLUTION_PX:
        status = refused("the object is too small in this image: come closer")
    else:
        last = None if before is None else before.value
        status = plausible(read_patch(patch, spec, digits_taught=digits_taught, before=last), spec, before)
    if not is_outlined and not (status.answered and status.confidence >= TELLS):
        return replace(reading, reason=NO_OUTLINE)
    return reading.saying(status)


def _is_bare(patch: Patch, noise: float) -> bool:
    """Whether the patch shows nothing that stands out from the noise."""
    smooth = cv2.GaussianBlur(patch.gray, (0, 0), 1.5)
    return float(np.percentile(smooth, 97)) - float(np.percentile(smooth, 3)) < 1.5 * noise + 6.0


def plausible(status: PatchReading, spec: PanelObject, before: ObjectReading | None) -> PatchReading:
    """The status, or a refusal when it jumps from the previous value without strong evidence."""
    if before is None or before.value is None or status.value is None or status.confidence >= JUMP_CONFIDENCE:
        return status
    scale: Scale | None = getattr(spec, "scale", None)
    if scale is not None:
        span = scale.maximum - scale.minimum
    elif isinstance(spec, Display):
        span = spec.maximum - spec.minimum
    else:
        return status
    if abs(status.value - before.value) <= JUMP * span:
        return status
    return doubted(
        status,
        f"{status.value:.4g} is far from the last reading {before.value:.4g} and the evidence is weak: look again",
    )


def _with_place(reading: ObjectReading, registration: Registration, spec: PanelObject) -> ObjectReading:
    """Adds the centre in panel metres: the pixel's ray cut with the plate, and the pixel's uncertainty there."""
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
    sigma_px = registration.shift_sigma_px.get(spec.name, 0.7)
    plate = J @ (np.eye(2) * sigma_px**2) @ J.T
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = plate + np.eye(2) * 1e-12
    covariance[2, 2] = 1e-12  # by definition on the plate
    return replace(reading, centre_m=point, centre_covariance_m2=covariance)


def _plate_jacobian(view: PanelProjection, point_m: tuple[float, float, float]) -> Array:
    """(2, 2) metres on the plate per pixel at a panel point."""
    step = 1e-3
    base = np.array(point_m)
    px = view.project(base + step * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    return np.asarray(np.linalg.inv(np.column_stack([px[1] - px[0], px[2] - px[0]]) / step), float)
