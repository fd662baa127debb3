"""The verb `recognise`: objects by vision, surfaces by range and what they belong to."""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.errors import NotFound
from service.operations.acquisition import look, scan, settle
from service.operations.inspect import ensure_located, run_recognise_taught
from service.operations.locate import go_to_overview, plate_in
from service.operations.relief import Sighting, find_by_surfaces, mark_of, sighting_json, surfaces_in
from service.operations.requests import RecogniseRequest
from service.operations.session import Session
from service.operations.stored import blind_answer, blind_in_stored, read_stored
from service.report.plots import png_of
from service.report.surfaces import surfaces_picture


def run_recognise(session: Session, request: RecogniseRequest) -> dict[str, Any]:
    """Objects of the panel file or of any panel in the image, and surfaces in the range image, as asked."""
    if request.image is not None:
        session.progress(0.1, "look at the stored image")
        return blind_in_stored(session, request) if request.mode == "blind" else read_stored(session, request)
    answer: dict[str, Any] = {}
    if "vision" in request.use:
        answer |= run_recognise_taught(session, request) if request.mode == "taught" else _blind(session, request)
    if "range" in request.use:
        answer |= _by_range(session, request)
    return answer


def _blind(session: Session, request: RecogniseRequest) -> dict[str, Any]:
    """Which kinds of object are where in this image, without a panel file."""
    if request.move:
        session.progress(0.1, "drive to the overview")
        go_to_overview(session)
        settle(session)
    session.progress(0.5, "recognise")
    seen = look(session, request.camera)
    return blind_answer(
        session, seen.pixels, (session.panel.width_m, session.panel.height_m), focal_px=seen.intrinsics.fx_px
    )


def _by_range(session: Session, request: RecogniseRequest) -> dict[str, Any]:
    """The surfaces of one range image, and the objects of the panel file whose surfaces are among them."""
    if request.move and "vision" not in request.use:
        ensure_located(session.part(0.0, 0.6))
        session.progress(0.6, "drive to the overview")
        go_to_overview(session)
        settle(session)
    session.progress(0.9, "scan")
    image = scan(session)
    scene, believed = surfaces_in(image), session.believed_panel()
    answer: dict[str, Any] = {
        "surfaces": [
            {"label": s.label, "type": str(s.type), "primitive": s.primitive, "pixels": s.pixels, "rms_m": s.rms_m}
            for s in scene.surfaces
        ],
        "plate": None,
        "by_surfaces": [],
    }
    sightings: list[Sighting] = []
    try:
        fit = plate_in(session, image).fit
        sightings = find_by_surfaces(scene, image, session.panel, believed, fit.surface)
        label = int(np.bincount(scene.labels[fit.inliers]).argmax())
        answer |= {"plate": label or None, "by_surfaces": [sighting_json(s) for s in sightings]}
    except NotFound as error:
        answer["no_plate"] = error.what  # what else is seen is an answer, too
    drawn = surfaces_picture(scene, [mark_of(sighting, image, believed) for sighting in sightings])
    return answer | {"range_picture": session.context.task.artefact("surfaces.png", png_of(drawn), "image/png")}
