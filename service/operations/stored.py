"""Answers from stored images instead of live cameras; nothing moves, and the cell's facts do not change."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.calibration import CameraIntrinsics
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose
from hal.panel import Panel
from perception.vision import ObjectReading
from service.knowledge.images import ImageStore
from service.knowledge.store import KnowledgeStore
from service.operations.session import Session, panel_object_or_all
from service.report.plots import png_of
from service.schema.requests import InspectRequest, RecogniseRequest, StoredLook
from service.schema.results import CandidateResult, InspectResult, ObjectResult, PossibleNumber, RecogniseResult

if TYPE_CHECKING:
    from perception.vision import Knowledge, PanelProjection

Pixels = NDArray[np.uint8]
PICTURE_WIDTH_PX = 1600  # wider pictures are reduced to this width for display
BORDER_SIGMA_PX = 1.0  # of a corner of the plate where two of its sides meet
CLICK_SIGMA_PX = 3.0  # of one that a person clicked


def read_stored(session: Session, request: RecogniseRequest | InspectRequest) -> InspectResult:
    """Read every object of a taught panel in a stored image; the answer has an annotated picture.

    Raises:
        NoSuchImage, NoSuchKnowledge: the image or the panel is unknown.
        InvalidRequest, NotObservable, NotFound, Ambiguous: the image gives no answer; says why and what helps.
    """
    from perception.vision import as_gray, draw_annotated, inspect_view

    panel = panel_of(session, request.panel)
    names = panel_object_or_all(panel, request.objects)
    pixels, view = stored_view(session, request, panel)
    readings = inspect_view(
        pixels, as_gray(pixels), view, panel, names=names, least_confidence=request.least_confidence
    )
    picture = shown(draw_annotated(pixels, readings))
    return InspectResult(
        panel=panel.name,
        objects=[object_result(reading) for reading in readings],
        missing=[reading.name for reading in readings if not reading.present],
        pictures=[session.context.task.artefact("annotated.png", png_of(picture), "image/png")],
    )


def blind_in_stored(session: Session, request: RecogniseRequest) -> RecogniseResult:
    """Find kinds of objects and their places in a stored image; errors as for `read_stored`."""
    from perception.vision import as_gray, one_plate

    pixels = _stores(session)[0].pixels(request.image or "")
    plate_m = request.plate_m
    if plate_m is None:
        panel = panel_of(session, request.panel)
        plate_m = (panel.width_m, panel.height_m)
    gray = as_gray(pixels)
    lens = _lens(session, request, gray)
    focal_px = lens.fx_px if lens is not None else None
    view = None if request.corners_px is None else one_plate(gray, plate_m, corners_px=request.corners_px).view
    return blind_answer(session, pixels, plate_m, focal_px=focal_px, view=view)


def blind_answer(
    session: Session,
    pixels: Pixels,
    plate_m: tuple[float, float],
    *,
    focal_px: float | None,
    view: PanelProjection | None = None,
) -> RecogniseResult:
    """Return all candidates, the refused ones with their reasons, and a picture of the others."""
    from perception.vision import draw_outlines, recognise

    found = recognise(pixels, knowledge_of(session), plate_m=plate_m, focal_px=focal_px, view=view)
    taken = [candidate for candidate in found if candidate.reason is None]
    texts = [f"{candidate.kind} {candidate.confidence:.2f}" for candidate in taken]
    outlined = draw_outlines(pixels, [candidate.box_px for candidate in taken], texts, [True] * len(taken))
    picture = png_of(shown(outlined))
    return RecogniseResult(
        candidates=[CandidateResult.model_validate(candidate) for candidate in found],
        pictures=[session.context.task.artefact("blind.png", picture, "image/png")],
    )


def panel_of(session: Session, name: str | None) -> Panel:
    """Return a taught panel by its name; the cell's own panel for None or its own name.

    Raises:
        NoSuchKnowledge: no panel of that name was taught.
    """
    if name is None or name == session.panel.name:
        return session.panel
    return _stores(session)[1].panel(name)


def object_result(reading: ObjectReading, base_from_panel: UncertainPose | None = None) -> ObjectResult:
    """Return a reading in the form of the API, with positions in panel and base frame if the panel's pose is known."""
    in_panel_m = reading.centre_m if base_from_panel is not None else None
    in_base_m = None
    if in_panel_m is not None and base_from_panel is not None:
        in_base_m = base_from_panel.parent_from_child.apply(in_panel_m).tolist()
    return ObjectResult(
        name=reading.name,
        kind=reading.kind,
        present=reading.present,
        value=reading.value,
        unit=reading.unit,
        uncertainty=reading.uncertainty,
        state=reading.state,
        text=reading.text,
        confidence=reading.confidence,
        reason=reading.reason,
        possible=[PossibleNumber.model_validate(number) for number in reading.possible],
        centre_px=reading.centre_px.tolist(),
        centre_in_panel_m=None if in_panel_m is None else in_panel_m.tolist(),
        centre_in_base_m=in_base_m,
    )


def shown(picture: Pixels) -> Pixels:
    """Return the picture, reduced to at most PICTURE_WIDTH_PX."""
    width = picture.shape[1]
    if width <= PICTURE_WIDTH_PX:
        return picture
    scale = PICTURE_WIDTH_PX / width
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def knowledge_of(session: Session) -> Knowledge:
    """Return the looks that ship with the system, those of the cell, and those that were taught."""
    return _stores(session)[1].knowledge()


def _stores(session: Session) -> tuple[ImageStore, KnowledgeStore]:
    runs = session.context.runs_dir
    return ImageStore(runs), KnowledgeStore.of_runs(runs, session.cell)


def stored_view(session: Session, request: StoredLook, panel: Panel) -> tuple[Pixels, PanelProjection]:
    """Return the stored image of an upright panel and the panel's place in it; errors as for `read_stored`."""
    from perception.vision import as_gray, check_upright

    pixels = _stores(session)[0].pixels(request.image or "")
    gray = as_gray(pixels)
    view = _view(session, request, gray, panel)
    check_upright(gray, view, panel)
    return pixels, view


def _view(session: Session, request: StoredLook, gray: Pixels, panel: Panel) -> PanelProjection:
    """Return the panel's place: the caller's, or by the panel's border, through the lens if it is known."""
    from perception.vision import CameraProjection, estimate, one_plate

    lens = _lens(session, request, gray)
    if lens is not None and request.camera_from_panel is not None:
        return CameraProjection(intrinsics=lens, camera_from_panel=request.camera_from_panel.pose())
    plate_m = request.plate_m or (panel.width_m, panel.height_m)
    focal_px = lens.fx_px if lens is not None else None
    view = one_plate(gray, plate_m, focal_px=focal_px, corners_px=request.corners_px).view
    if lens is None:
        return view
    sigma_px = BORDER_SIGMA_PX if request.corners_px is None else CLICK_SIGMA_PX
    corners_m = np.column_stack([view.corners_m, np.zeros(4)])
    pose = estimate(corners_m, view.project(corners_m), sigma_px**2, lens)
    return CameraProjection(
        intrinsics=lens,
        camera_from_panel=UncertainPose(parent_from_child=pose.camera_from_object, covariance=pose.covariance),
    )


def _lens(session: Session, request: StoredLook, gray: Pixels) -> CameraIntrinsics | None:
    """Return the lens of the request, checked against the image's size."""
    height, width = gray.shape
    if request.lens is not None:
        return CameraIntrinsics(width_px=width, height_px=height, **request.lens.model_dump())
    if request.camera is None:
        return None
    lens = session.lens(request.camera)
    if (lens.width_px, lens.height_px) != (width, height):
        raise InvalidRequest(
            f"the image has {width}x{height} px, camera {request.camera!r} is calibrated for"
            f" {lens.width_px}x{lens.height_px}",
            hint="name the camera that took it, give its `lens`, or leave both out",
        )
    return lens
