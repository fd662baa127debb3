"""Teaching of kinds by examples, of whole panels by clicks and answers, and of looks from a known panel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from perception.vision.teaching.from_panel import PanelLooks, teach_from_panel
    from perception.vision.teaching.lesson import (
        Example,
        Overview,
        check,
        example_at,
        example_in,
        likest,
        overview_of,
        surroundings,
        teach,
        teach_example,
    )
    from perception.vision.teaching.panel_lights import LightsFound, find_border_lights
    from perception.vision.teaching.panel_questions import kind_question, questions
    from perception.vision.teaching.panel_teach import PanelObjectDraft, object_row, panel_text

__all__ = [
    "Example",
    "LightsFound",
    "Overview",
    "PanelLooks",
    "PanelObjectDraft",
    "check",
    "example_at",
    "example_in",
    "find_border_lights",
    "kind_question",
    "likest",
    "object_row",
    "overview_of",
    "panel_text",
    "questions",
    "surroundings",
    "teach",
    "teach_example",
    "teach_from_panel",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
