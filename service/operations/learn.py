"""The verb `learn`: the panel's own overview teaches what its objects look like; blind recognition then knows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.geometry import compose
from service.knowledge.store import KnowledgeStore
from service.knowledge.teach import learn_panel
from service.operations.acquisition import look, settle
from service.operations.inspect import ensure_located
from service.operations.locate import go_to_overview
from service.operations.session import Session
from service.operations.stored import Pixels, panel_of, shown, stored_view
from service.report.plots import png_of
from service.schema.requests import LearnRequest
from service.schema.results import LearnResult

if TYPE_CHECKING:
    from hal.panel import Panel
    from perception.vision import PanelLooks, PanelProjection


def run_learn(session: Session, request: LearnRequest) -> LearnResult:
    """Learn the looks of the panel's objects from an overview of now, or from a stored one.

    Raises:
        NoSuchImage, NoSuchKnowledge: unknown image or panel.
        InvalidRequest, NotObservable, NotFound, Ambiguous: the overview teaches nothing; says why and what helps.
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
    """The overview with the objects that taught: green are recognised blind now, amber are not."""
    from perception.vision import draw_outlines

    return draw_outlines(
        pixels,
        [each.box_px for each in looks.shown],
        [f"{each.panel_object.name}: {each.panel_object.kind}" for each in looks.shown],
        [each.panel_object.name in looks.known_now for each in looks.shown],
    )
