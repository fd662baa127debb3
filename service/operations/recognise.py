"""The verb `recognise`: objects by vision, surfaces by range."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.errors import Unsupported
from perception.range import PinholeSensor, RangeScene, analyse
from service.operations.eyes import look, scan, settle
from service.operations.inspect import run_recognise_taught
from service.operations.locate import go_to_overview
from service.operations.requests import RecogniseRequest
from service.operations.session import Session
from service.report.plots import png_of

if TYPE_CHECKING:
    from perception.vision.blind import Candidate


def run_recognise(session: Session, request: RecogniseRequest) -> dict[str, Any]:
    """Objects of the panel file or of any panel in the image, and surfaces in the range image, as asked."""
    answer: dict[str, Any] = {}
    if "vision" in request.use:
        answer |= run_recognise_taught(session, request) if request.mode == "taught" else _blind(session, request)
    if "range" in request.use:
        answer["surfaces"] = _surfaces(session, request)
    return answer


def _blind(session: Session, request: RecogniseRequest) -> dict[str, Any]:
    """Which kinds of object are where in this image, without a panel file."""
    from perception.vision.blind import recognise
    from perception.vision.knowledge import shipped_knowledge

    if request.move:
        go_to_overview(session)
        settle(session)
    seen = look(session, request.camera)
    plate_m = (session.panel.width_m, session.panel.height_m)
    found = recognise(seen.pixels, shipped_knowledge(), plate_m=plate_m, focal_px=seen.intrinsics.fx_px)
    picture = png_of(_drawn(seen.pixels, [c for c in found if c.reason is None]))
    return {
        "candidates": list(found),
        "pictures": [session.context.task.artefact("blind.png", picture, "image/png")],
    }


def _drawn(pixels: NDArray[np.uint8], candidates: Sequence[Candidate]) -> NDArray[np.uint8]:
    """The image with a ring and a name at every candidate, RGB."""
    picture = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB) if pixels.ndim == 2 else pixels.copy()
    for candidate in candidates:
        u, v = (round(float(x)) for x in candidate.centre_px)
        cv2.circle(picture, (u, v), 12, (40, 220, 60), 2, cv2.LINE_AA)
        text = f"{candidate.kind} {candidate.confidence:.2f}"
        cv2.putText(picture, text, (u + 14, v + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 220, 60), 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def _surfaces(session: Session, request: RecogniseRequest) -> list[dict[str, Any]]:
    if request.move and "vision" not in request.use:
        go_to_overview(session)
        settle(session)
    session.progress(0.9, "scan")
    image = scan(session)
    c = image.capabilities
    if c.projection != "pinhole":
        raise Unsupported(f"{image.scanner} has {c.projection} projection", hint="use a pinhole range scanner")
    sensor = PinholeSensor(width_px=c.width, height_px=c.height, fx_px=c.fx, fy_px=c.fy, cx_px=c.cx, cy_px=c.cy)
    scene: RangeScene = analyse(image.depth_m, sensor)
    return [
        {"label": s.label, "type": str(s.type), "primitive": s.primitive, "pixels": s.pixels, "rms_m": s.rms_m}
        for s in scene.surfaces
    ]
