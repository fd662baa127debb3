"""The verbs `recognise` and `learn`: find objects by vision and surfaces by range, and learn looks from the panel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hal.errors import NotFound
from hal.geometry import compose
from perception.range import Sighting, Surface
from service.jsonable import jsonable
from service.knowledge.store import KnowledgeStore
from service.knowledge.teach import learn_panel
from service.operations.acquisition import look, scan, settle
from service.operations.inspect import ensure_located, run_recognise_taught
from service.operations.locate import go_to_overview, plate_in
from service.operations.range_detection import find_by_surfaces, mark_of, surfaces_in
from service.operations.session import Session
from service.operations.stored import Pixels, blind_answer, blind_in_stored, panel_of, read_stored, shown, stored_view
from service.report.plots import png_of
from service.report.surfaces import surfaces_picture
from service.schema.requests import LearnRequest, RecogniseRequest
from service.schema.results import (
    LearnResult,
    RangeFindings,
    RecogniseResult,
    SurfaceResult,
    SurfaceSighting,
    estimated,
    fields_of,
)

if TYPE_CHECKING:
    from hal.panel import Panel
    from perception.vision import PanelProjection
    from perception.vision.teaching import PanelLooks


def run_recognise(session: Session, request: RecogniseRequest) -> RecogniseResult:
    """Run the verb `recognise`: find objects of the panel file or of any panel, and surfaces in the range image."""
    if request.image is not None:
        session.progress(0.1, "look at the stored image")
        if request.mode == "blind":
            return blind_in_stored(session, request)
        return RecogniseResult(**fields_of(read_stored(session, request)))
    answer = RecogniseResult()
    if "vision" in request.use and request.mode == "taught":
        answer = RecogniseResult(**fields_of(run_recognise_taught(session, request)))
    elif "vision" in request.use:
        answer = _blind(session, request)
    return answer.model_copy(update=fields_of(_by_range(session, request))) if "range" in request.use else answer


def _blind(session: Session, request: RecogniseRequest) -> RecogniseResult:
    """Find kinds of objects and their places in an image, without a panel file."""
    if request.move:
        session.progress(0.1, "drive to the overview")
        go_to_overview(session)
        settle(session)
    session.progress(0.5, "recognise")
    seen = look(session, request.camera)
    return blind_answer(
        session, seen.pixels, (session.panel.width_m, session.panel.height_m), focal_px=seen.intrinsics.fx_px
    )


def _by_range(session: Session, request: RecogniseRequest) -> RangeFindings:
    """Find the surfaces of one range image, and objects by them."""
    if request.move and "vision" not in request.use:
        ensure_located(session.part(0.0, 0.6))
        session.progress(0.6, "drive to the overview")
        go_to_overview(session)
        settle(session)
    session.progress(0.9, "scan")
    image = scan(session)
    scene, believed = surfaces_in(image), session.believed_panel()
    plate: int | None = None
    no_plate: str | None = None
    sightings: list[Sighting] = []
    try:
        fit = plate_in(session, image).fit
        sightings = find_by_surfaces(scene, image, session.panel, believed, fit.surface)
        plate = int(np.bincount(scene.labels[fit.inliers]).argmax()) or None
    except NotFound as error:
        no_plate = error.what  # the other surfaces are still an answer
    drawn = surfaces_picture(scene, [mark_of(sighting, image, believed) for sighting in sightings])
    return RangeFindings(
        surfaces=[_surface_result(surface) for surface in scene.surfaces],
        plate=plate,
        by_surfaces=[_sighting_result(sighting) for sighting in sightings],
        no_plate=no_plate,
        range_picture=session.context.task.artefact("surfaces.png", png_of(drawn), "image/png"),
    )


def _surface_result(surface: Surface) -> SurfaceResult:
    return SurfaceResult(
        label=surface.label,
        type=str(surface.type),
        primitive=jsonable(surface.primitive),
        pixels=surface.pixels,
        rms_m=surface.rms_m,
    )


def _sighting_result(sighting: Sighting) -> SurfaceSighting:
    panel_object, match = sighting.panel_object, sighting.match
    if match is None or sighting.base_from_object is None:
        return SurfaceSighting(name=panel_object.name, kind=panel_object.kind, found=False, why=sighting.why)
    return SurfaceSighting(
        name=panel_object.name,
        kind=panel_object.kind,
        found=True,
        base_from_object=estimated(sighting.base_from_object),
        off_panel_file_m=sighting.off_m,
        state=sighting.state,
        state_sigma=match.state_sigma,
        seen=match.seen,
        score=match.score,
        surfaces=match.labels,
    )


def run_learn(session: Session, request: LearnRequest) -> LearnResult:
    """Learn the looks of the panel's objects from a new or a stored overview.

    Raises:
        NoSuchImage, NoSuchKnowledge: the image or the panel is unknown.
        InvalidRequest, NotObservable, NotFound, Ambiguous: nothing can be learned from the overview.
    """
    from perception.vision import CameraProjection

    if request.image is not None:
        session.progress(0.1, "look at the stored image")
        panel = panel_of(session, request.panel)
        return _learn(session, *stored_view(session, request, panel), panel)
    if request.move:
        ensure_located(session.part(0.0, 0.5))
        session.progress(0.5, "drive to the overview")
        go_to_overview(session)
    settle(session)
    session.progress(0.8, "look")
    seen = look(session, request.camera)
    pose = compose(seen.base_from_camera.inverse(), session.known_panel())
    live = CameraProjection(intrinsics=seen.intrinsics, camera_from_panel=pose)
    return _learn(session, seen.pixels, live, session.panel)


def _learn(session: Session, pixels: Pixels, view: PanelProjection, panel: Panel) -> LearnResult:
    session.progress(0.9, "learn")
    store = KnowledgeStore.of_runs(session.context.runs_dir, session.cell)
    learned = learn_panel(store, pixels, view, panel)
    picture = png_of(shown(_drawn(pixels, learned.looks)))
    kept = session.context.task.artefact("learned.png", picture, "image/png")
    return learned.result().model_copy(update={"pictures": [kept]})


def _drawn(pixels: Pixels, looks: PanelLooks) -> Pixels:
    """Draw the objects that gave looks over the overview: green if blind recognition finds them now, else amber."""
    from perception.vision import draw_outlines

    return draw_outlines(
        pixels,
        [each.box_px for each in looks.shown],
        [f"{each.panel_object.name}: {each.panel_object.kind}" for each in looks.shown],
        [each.panel_object.name in looks.known_now for each in looks.shown],
    )
