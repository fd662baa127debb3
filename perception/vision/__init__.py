"""Vision: pose of the panel from its lights, and objects of the panel with their states, from images (paper II).

The module `viewpoints` proposes camera poses, and `teaching` adds kinds and panels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from perception.vision.annotate import draw_annotated, draw_outlines, said
    from perception.vision.finding.blind import recognise
    from perception.vision.finding.framing import check_upright, one_plate
    from perception.vision.image import as_gray, check_image, decode
    from perception.vision.inspection import inspect, inspect_view
    from perception.vision.knowledge import Knowledge, TaughtKind
    from perception.vision.knowledge_files import kind_files, kind_text, load_kind, load_knowledge, write_kind
    from perception.vision.lights import PanelPrior, find_panel, find_panel_lights
    from perception.vision.multi_view import merge_views
    from perception.vision.panel_ways.looks import find_by_looks
    from perception.vision.panel_ways.outline import find_by_outline
    from perception.vision.panel_ways.sighting import PanelSighting, PanelWay, compare
    from perception.vision.panel_ways.tags import find_by_tags
    from perception.vision.photographs.motion import over_pictures
    from perception.vision.photographs.reader import read_photograph
    from perception.vision.projection import CameraProjection, PanelProjection
    from perception.vision.quadrangle import estimate
    from perception.vision.reading import ObjectReading, answer_at
    from perception.vision.registration.outline import contour_m
    from perception.vision.registration.rims import RimView, find_rims
    from perception.vision.warm import warm_up

__all__ = [
    "CameraProjection",
    "Knowledge",
    "ObjectReading",
    "PanelPrior",
    "PanelProjection",
    "PanelSighting",
    "PanelWay",
    "RimView",
    "TaughtKind",
    "answer_at",
    "as_gray",
    "check_image",
    "check_upright",
    "compare",
    "contour_m",
    "decode",
    "draw_annotated",
    "draw_outlines",
    "estimate",
    "find_by_looks",
    "find_by_outline",
    "find_by_tags",
    "find_panel",
    "find_panel_lights",
    "find_rims",
    "inspect",
    "inspect_view",
    "kind_files",
    "kind_text",
    "load_kind",
    "load_knowledge",
    "merge_views",
    "one_plate",
    "over_pictures",
    "read_photograph",
    "recognise",
    "said",
    "warm_up",
    "write_kind",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
