"""A whole new panel from one image: every object is clicked on, a few questions are answered, and TOML comes out.

The paper: "The user is directed through a question-answer sequence to acquire the description of [...] various objects
and their subparts" (section II-A). Places and sizes come from the outlines under the clicks, the rest from the answers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.panel import Panel
from hal.strict import validate
from hal.toml_text import toml_text
from perception.vision.teaching.panel_lights import LightsFound
from perception.vision.teaching.panel_questions import Question, questions
from perception.vision.teaching.teach import Example, Overview, plate_points

CORNERS = ("upper_left", "upper_right", "lower_right", "lower_left")
CAP_M = 0.012  # of a slider, along its track
PIVOT_SHARE, NEEDLE_SHARE = 0.28, 0.6  # of a moving-coil meter's height


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelObjectDraft:
    """An object of the new panel: its kind and name, what was clicked, and the answers to `questions(kind)`."""

    kind: str
    name: str
    example: Example
    answers: Mapping[str, str]


def panel_text(name: str, overview: Overview, lights: LightsFound, objects: Sequence[PanelObjectDraft]) -> str:
    """TOML of a panel file.

    Raises:
        InvalidRequest: an answer is no number or no choice; names object and question.
        ConfigError: what came out is no panel: a name twice, an object off the plate.
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
    """One object's keys of the panel file: from its outline, and from the answers.

    Raises:
        InvalidRequest: an answer is no number or no choice; names object and question.
    """
    asked = {question.key: question for question in questions(draft.kind)[1:]}
    unknown = sorted(set(draft.answers) - set(asked) - {"name"})
    if unknown:
        raise InvalidRequest(
            f"{draft.name}: nobody asked for {unknown[0]!r} of a {draft.kind}",
            hint=f"questions: {', '.join(asked) or 'none but the name'}",
        )
    reply = _Replies(draft=draft, asked=asked, overview=overview)
    width, height = draft.example.size_m
    row: dict[str, Any] = {"kind": draft.kind, "name": draft.name, "position_m": _metres(reply.centre_m)}
    radius = {"radius_m": round((width + height) / 4, 4)}
    match draft.kind:
        case "gauge":
            return {**row, **radius, "scale": reply.pointer_scale(0.0)}
        case "panel_meter":
            below = round(PIVOT_SHARE * height, 4)
            sizes = {"width_m": round(width, 4), "height_m": round(height, 4), "pivot_below_m": below}
            return {**row, **sizes, "needle_m": round(NEEDLE_SHARE * height, 4), "scale": reply.pointer_scale(below)}
        case "display":
            sizes = {"width_m": round(width, 4), "height_m": round(height, 4)}
            counts = {key: round(reply.number(key)) for key in ("digits", "decimals")}
            bounds = {key: reply.number(key) for key in ("minimum", "maximum")}
            return {**row, **sizes, **counts, "style": reply.text("style"), "unit": reply.text("unit"), **bounds}
        case "lamp":
            return {**row, **radius, "colour": reply.text("colour")}
        case "button":
            return {**row, **radius, "colour": reply.text("colour"), "latching": reply.text("latching") == "yes"}
        case "rotary":
            return {**row, **radius, "states": reply.states()}
        case "lever":
            return {**row, "length_m": round(_reach_m(draft, overview), 4), "states": reply.states()}
        case "slider":
            return {**row, **reply.track(width, height)}
        case "handwheel":
            return {**row, **radius, "spokes": round(reply.number("spokes"))}
        case "mushroom":
            return {**row, **radius}
    return row


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Replies:
    """The answers about one object, read as what they mean."""

    draft: PanelObjectDraft
    asked: Mapping[str, Question]
    overview: Overview

    @property
    def centre_m(self) -> Array:
        """A lever turns about where it was clicked; everything else sits in the middle of its outline."""
        example = self.draft.example
        if self.draft.kind == "lever" and len(example.clicks_m) != 2:
            return np.asarray(example.clicks_m[-1])
        if len(example.clicks_m) == 3 or example.outline is None:
            return np.asarray(example.clicks_m[-1])
        return np.asarray(self.overview.on_plate(example.outline.middle_px[None])[0])

    def text(self, key: str) -> str:
        question = self.asked[key]
        given = self.draft.answers.get(key, "").strip() or question.default
        if question.choices and given not in question.choices:
            raise InvalidRequest(
                f"{self.draft.name}: {key!r} is one of {', '.join(question.choices)}", hint="choose one of them"
            )
        return given

    def number(self, key: str) -> float:
        return _number(self.text(key), f"{self.draft.name}: {key!r}")

    def pointer_scale(self, pivot_below_m: float) -> dict[str, Any]:
        """The scale of a pointer whose pivot lies below the object's middle."""
        return {
            **self._ends(),
            "at_min": self._mark("at_min", pivot_below_m),
            "at_max": self._mark("at_max", pivot_below_m),
        }

    def track(self, width: float, height: float) -> dict[str, Any]:
        """A slider's travel and scale, from the outline of track and cap."""
        rises = self.text("rises")
        is_flat = rises in ("right", "left")
        travel = round(max((width if is_flat else height) - CAP_M, 0.01), 4)
        sign = 1.0 if rises in ("right", "up") else -1.0
        scale = {**self._ends(), "at_min": -sign * travel / 2, "at_max": sign * travel / 2}
        return {"angle_rad": 0.0 if is_flat else round(np.pi / 2, 4), "travel_m": travel, "scale": scale}

    def states(self) -> list[dict[str, Any]]:
        """Named places, given in degrees, as the panel file has them."""
        pairs = [part.partition("=") for part in self.text("states").split(",")]
        what = f"{self.draft.name}: place"
        return [{"name": n.strip(), "angle_rad": _radians(_number(a, f"{what} {n.strip()!r}"))} for n, _, a in pairs]

    def _ends(self) -> dict[str, Any]:
        return {"minimum": self.number("minimum"), "maximum": self.number("maximum"), "unit": self.text("unit")}

    def _mark(self, key: str, pivot_below_m: float) -> float:
        """An end of the scale: an angle in degrees, or a pixel on the mark."""
        text = self.text(key)
        if "," not in text:
            return _radians(self.number(key))
        u, v = (_number(part, f"{self.draft.name}: {key!r}") for part in text.split(",", 1))
        mark = plate_points(self.overview.view, [(u, v)], self.overview.plate_m)[0] - self.centre_m
        return round(float(np.arctan2(mark[0], mark[1] + pivot_below_m)), 4)


def _reach_m(draft: PanelObjectDraft, overview: Overview) -> float:
    """From a lever's hub to the far end of its outline."""
    example = draft.example
    if example.outline is None or len(example.clicks_m) == 2:
        return max(example.size_m) / 2
    corners = overview.on_plate(example.outline.polygon_px)
    return float(np.abs(corners - example.clicks_m[-1]).max())


def _metres(place: Array) -> list[float]:
    return [round(float(x), 4) for x in place]


def _radians(degrees: float) -> float:
    return round(float(np.deg2rad(degrees)), 4)


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InvalidRequest(f"{what} must be a number, not {text[:40]!r}", hint="for example 10.0") from None
    if not np.isfinite(value):
        raise InvalidRequest(f"{what} must be finite", hint="for example 10.0")
    return value
