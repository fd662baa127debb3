"""Teaching of a whole new panel from one image: clicks on the objects and answers to questions become a TOML file.

The paper: "The user is directed through a question-answer sequence to acquire the description of [...] various objects
and their subparts" (section II-A). Positions and sizes come from the outlines under the clicks, the rest from the
answers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.panel import Panel, Question
from hal.panel.kinds import kind_model
from hal.strict import validate
from hal.toml_text import toml_text
from perception.vision.teaching.lesson import Example, Overview, plate_points
from perception.vision.teaching.panel_lights import LightsFound
from perception.vision.teaching.panel_questions import questions

CORNERS = ("upper_left", "upper_right", "lower_right", "lower_left")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelObjectDraft:
    """An object of the new panel: its kind and name, what was clicked, and the answers to `questions(kind)`."""

    kind: str
    name: str
    example: Example
    answers: Mapping[str, str]


def panel_text(name: str, overview: Overview, lights: LightsFound, objects: Sequence[PanelObjectDraft]) -> str:
    """Return the TOML text of a panel file.

    Raises:
        InvalidRequest: an answer is not a number or not one of the choices; names object and question.
        ConfigError: the result is not a valid panel: a repeated name, or an object that is not on the plate.
    """
    width, height = overview.plate_m
    top: dict[str, Any] = {"schema": 1, "name": name, "width_m": width, "height_m": height}
    light_rows = [
        {"name": f"light_{corner}", "position_m": [*_metres(place), 0.0]}
        for corner, place in zip(CORNERS, lights.places_m, strict=True)
    ]
    object_rows = [object_row(draft, overview) for draft in objects]
    data = {**top, "lights": light_rows, "objects": object_rows}
    validate(data, Panel, source=f"panel {name!r}")
    remarks = ["Taught from one image: places and sizes are as good as its overview."]
    if not lights.are_seen:
        remarks.append("No border lights were seen: their places are a guess. Measure them.")
    return toml_text(data, remarks=remarks)


def object_row(draft: PanelObjectDraft, overview: Overview) -> dict[str, Any]:
    """Return the keys of one object in the panel file, from its outline and the answers.

    Raises:
        InvalidRequest: an answer is not a number or not one of the choices; names object and question.
    """
    asked = {question.key: question for question in questions(draft.kind)[1:]}
    unknown = sorted(set(draft.answers) - set(asked) - {"name"})
    if unknown:
        raise InvalidRequest(
            f"{draft.name}: nobody asked for {unknown[0]!r} of a {draft.kind}",
            hint=f"questions: {', '.join(asked) or 'none but the name'}",
        )
    reply = _Replies(draft=draft, asked=asked, overview=overview)
    row: dict[str, Any] = {"kind": draft.kind, "name": draft.name, "position_m": _metres(reply.centre_m)}
    return {**row, **kind_model(draft.kind).keys_of(reply)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Replies:
    """The answers about one object, converted to the types of the panel file's keys."""

    draft: PanelObjectDraft
    asked: Mapping[str, Question]
    overview: Overview

    @property
    def centre_m(self) -> Array:
        """Position (2,) of the object on the plate.

        An object that turns about a hub is where it was clicked; any other is in the middle of its outline.
        """
        example = self.draft.example
        if kind_model(self.draft.kind).turns_about_click and len(example.clicks_m) != 2:
            return np.asarray(example.clicks_m[-1])
        if len(example.clicks_m) == 3 or example.outline is None:
            return np.asarray(example.clicks_m[-1])
        return np.asarray(self.overview.on_plate(example.outline.middle_px[None])[0])

    def text(self, key: str) -> str:
        """Return the answer to a question, or its default; raises InvalidRequest if it is not one of the choices."""
        question = self.asked[key]
        given = self.draft.answers.get(key, "").strip() or question.default
        if question.choices and given not in question.choices:
            raise InvalidRequest(
                f"{self.draft.name}: {key!r} is one of {', '.join(question.choices)}", hint="choose one of them"
            )
        return given

    def number(self, key: str) -> float:
        """Return the answer to a question as a number."""
        return _number(self.text(key), f"{self.draft.name}: {key!r}")

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the outline."""
        width, height = self.draft.example.size_m
        return float(width), float(height)

    @property
    def reach_m(self) -> float:
        """Largest distance of the outline from the last click, along x or y."""
        example = self.draft.example
        if example.outline is None or len(example.clicks_m) == 2:
            return max(self.size_m) / 2
        corners = self.overview.on_plate(example.outline.polygon_px)
        return float(np.abs(corners - example.clicks_m[-1]).max())

    def states(self, key: str) -> list[dict[str, Any]]:
        """Return named angles from an answer such as "off=-45, on=45"."""
        pairs = [part.partition("=") for part in self.text(key).split(",")]
        what = f"{self.draft.name}: place"
        return [{"name": n.strip(), "angle_deg": _number(a, f"{what} {n.strip()!r}")} for n, _, a in pairs]

    def mark_deg(self, key: str, *, pivot_below_m: float = 0.0) -> float:
        """Return the angle of a mark, clockwise from up: the answer itself, or that of the pixel "u,v" in it.

        `pivot_below_m`: distance of the pivot below the object's middle.
        """
        text = self.text(key)
        if "," not in text:
            return self.number(key)
        u, v = (_number(part, f"{self.draft.name}: {key!r}") for part in text.split(",", 1))
        mark = plate_points(self.overview.view, [(u, v)], self.overview.plate_m)[0] - self.centre_m
        return round(float(np.degrees(np.arctan2(mark[0], mark[1] + pivot_below_m))), 2)


def _metres(place: Array) -> list[float]:
    """Return a place rounded to 0.1 mm."""
    return [round(float(x), 4) for x in place]


def _number(text: str, what: str) -> float:
    """Return the text as a finite number; raises InvalidRequest if it is none."""
    try:
        value = float(text)
    except ValueError:
        raise InvalidRequest(f"{what} must be a number, not {text[:40]!r}", hint="for example 10.0") from None
    if not np.isfinite(value):
        raise InvalidRequest(f"{what} must be finite", hint="for example 10.0")
    return value
