"""A whole new panel from one image: every object is clicked on, a few questions are answered, and TOML comes out.

The paper: "The user is directed through a question-answer sequence to acquire the description of [...] various objects
and their subparts" (section II-A). Places and sizes come from the outlines under the clicks, the rest from the answers.
Every question has an answer that stands when nothing is said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.errors import InvalidRequest
from hal.panel import OBJECT_KINDS, Panel
from hal.strict import validate
from perception.toml_text import toml_document
from perception.vision.features import PLATE_PX_PER_M
from perception.vision.knowledge import NOTHING, Knowledge
from perception.vision.sub_object import sub_objects
from perception.vision.teach import Example, Overview, plate_points
from perception.vision.view import Array

CORNERS = ("upper_left", "upper_right", "lower_right", "lower_left")
SIDES = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], float)
LIGHT_INSET_M = 0.015  # where lights are put when none are seen: the file says that it is a guess
LIGHT_REACH_M = 0.06  # how far from its corner a border light may sit
LIGHT_RADII_M = (0.003, 0.014)
LIGHTS_AGREE_M = 0.006  # border lights sit alike in their corners
SNAP_M = 0.006
COLOURS = ("green", "red", "amber", "blue", "white")
CAP_M = 0.012  # of a slider, along its track
PIVOT_SHARE, NEEDLE_SHARE = 0.28, 0.6  # of a moving-coil meter's height


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """One step of the dialogue; `choices` is empty where any text or number will do. `default` stands if unanswered."""

    key: str
    text: str
    choices: tuple[str, ...] = ()
    default: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelObjectDraft:
    """An object of the new panel: its kind and name, what was clicked, and the answers to `questions(kind)`."""

    kind: str
    name: str
    example: Example
    answers: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightsFound:
    """(4, 2) border lights on the plate, upper left first and clockwise; `are_seen` False: put there by a guess."""

    places_m: Array
    are_seen: bool


NAME = Question(key="name", text="What is it called (a short name: small letters, digits, underscores)?")
SCALE = (
    Question(key="minimum", text="Which value stands at the low end of the scale?", default="0"),
    Question(key="maximum", text="Which value stands at the high end?", default="10"),
    Question(key="unit", text="In which unit?", default="bar"),
)
MARKS = "degrees clockwise from straight up, or x,y of a pixel on the mark"
PLACES = "Its places: name=degrees clockwise from straight up, separated by commas?"


def _pointer(low: str, high: str) -> tuple[Question, ...]:
    return (
        *SCALE,
        Question(key="at_min", text=f"Where is the low end ({MARKS})?", default=low),
        Question(key="at_max", text=f"Where is the high end ({MARKS})?", default=high),
    )


QUESTIONS: dict[str, tuple[Question, ...]] = {
    "gauge": _pointer("-135", "135"),
    "panel_meter": _pointer("-45", "45"),
    "display": (
        Question(key="digits", text="How many digits?", default="4"),
        Question(key="decimals", text="How many of them after the point?", default="0"),
        Question(key="style", text="Glowing or dark segments?", choices=("led", "lcd"), default="led"),
        Question(key="unit", text="In which unit?"),
        Question(key="minimum", text="What is the least that it can show?", default="0"),
        Question(key="maximum", text="What is the most?", default="9999"),
    ),
    "lamp": (Question(key="colour", text="Which colour?", choices=COLOURS, default="green"),),
    "button": (
        Question(key="colour", text="Which colour?", choices=(*COLOURS, "black"), default="green"),
        Question(key="latching", text="Does it stay in when pressed?", choices=("no", "yes"), default="no"),
    ),
    "toggle": (),
    "rotary": (Question(key="states", text=PLACES, default="off=-45, on=45"),),
    "slider": (
        *SCALE,
        Question(key="rises", text="Where does the value rise to?", choices=("right", "left", "up", "down"),
                 default="right"),
    ),
    "lever": (Question(key="states", text=PLACES, default="closed=90, open=0"),),
    "handwheel": (Question(key="spokes", text="How many spokes?", default="3"),),
    "mushroom": (),
}  # fmt: skip


def kind_question(knowledge: Knowledge, suggested: str = "") -> Question:
    """The first question about what was clicked."""
    known = sorted({*OBJECT_KINDS, *(kind.name for kind in knowledge.kinds)} - {NOTHING})
    return Question(key="kind", text="What kind of object is this?", choices=tuple(known), default=suggested)


def questions(kind: str) -> tuple[Question, ...]:
    """What must be known of one clicked object to write it into a panel file.

    Raises:
        InvalidRequest: a panel file knows no such kind.
    """
    if kind not in QUESTIONS:
        raise InvalidRequest(
            f"a panel file knows no {kind!r}: a kind without a reader can be found, not read",
            hint=f"kinds of a panel file: {', '.join(OBJECT_KINDS)}",
        )
    return (NAME, *QUESTIONS[kind])


def find_border_lights(overview: Overview, clicks_px: Sequence[tuple[float, float]] = ()) -> LightsFound:
    """The four border lights: those clicked on, or the small circles that sit alike in the four corners.

    Raises:
        InvalidRequest: neither none nor four clicks.
        NotFound: a click beside the plate.
    """
    if len(clicks_px) not in (0, 4):
        raise InvalidRequest(
            f"{len(clicks_px)} lights were clicked on", hint="click on all four border lights, or none"
        )
    half = np.array(overview.plate_m) / 2
    low, high = LIGHT_RADII_M
    round_ones = [
        overview.on_plate(o.middle_px[None])[0]
        for o in sub_objects(overview.ground)
        if o.shape == "circle" and low <= o.size_px[0] / PLATE_PX_PER_M / 2 <= high
    ]
    circles = np.array(round_ones).reshape(-1, 2)
    if len(clicks_px) == 4:
        clicked = plate_points(overview.view, clicks_px, overview.plate_m)
        places = np.array([_near(place, circles) for place in clicked])
        return LightsFound(places_m=places[_clockwise(places)], are_seen=True)
    corners = SIDES * half
    found = [_in_corner(corner, circles) for corner in corners]
    if all(place is not None for place in found):
        insets = np.array([np.abs(corner - place) for corner, place in zip(corners, found, strict=True)])
        if np.ptp(insets, axis=0).max() < LIGHTS_AGREE_M:
            return LightsFound(places_m=np.array(found), are_seen=True)
    return LightsFound(places_m=corners - SIDES * LIGHT_INSET_M, are_seen=False)


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
    validate({**top, "lights": light_rows, "objects": object_rows}, Panel, source=f"panel {name!r}")
    note = [] if lights.are_seen else ["# No border lights were seen: their places are a guess. Measure them.\n"]
    remark = "# Taught from one image: places and sizes are as good as its overview.\n"
    return remark + "".join(note) + toml_document(top, {"lights": light_rows, "objects": object_rows})


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


def _in_corner(corner: Array, circles: Array) -> Array | None:
    """The circle nearest to a corner of the plate, if one is near."""
    away = np.abs(circles - corner).max(axis=1, initial=0.0)
    near = np.flatnonzero(away < LIGHT_REACH_M)
    return circles[near[int(away[near].argmin())]] if len(near) else None


def _near(place: Array, circles: Array) -> Array:
    """The middle of the circle that was clicked on, or the click."""
    away = np.linalg.norm(circles - place, axis=1)
    return np.asarray(circles[int(away.argmin())] if len(away) and away.min() < SNAP_M else place)


def _clockwise(places: Array) -> list[int]:
    """Order of four places: upper left, upper right, lower right, lower left."""
    rows = np.argsort(-places[:, 1], kind="stable")
    (a, b), (c, d) = (sorted(rows[k : k + 2], key=lambda i: float(places[i, 0])) for k in (0, 2))
    return [int(a), int(b), int(d), int(c)]


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
