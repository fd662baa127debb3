"""Teaching: one image and at most three clicks, or a few answers, make a new kind, a further look, or a whole panel file.

A further look is only taken when it takes nothing away from another kind: every look that the others were taught keeps
its own kind as the likest. `check` shows what the system now finds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.errors import Ambiguous, InvalidRequest, NotFound
from hal.panel import OBJECT_KINDS
from perception.vision.blind import PLATE_M, Candidate, candidate_places, lay_out, recognise
from perception.vision.features import PLATE_PX_PER_M, look_at
from perception.vision.image import as_gray
from perception.vision.knowledge import NOTHING, Kind, Knowledge
from perception.vision.match import distances
from perception.vision.plate import find_plate
from perception.vision.view import Array, View, homography

SNAP_M = 0.004  # a click is taken to the middle of the sub-object that lies that near
SAME_LOOK = 0.10  # a look this near to one already taught teaches nothing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lesson:
    """What a teaching step made of it.

    Attributes:
        knowledge: with the new look.
        kind: the kind that was taught.
        centre_m: (2,) where on the plate (origin in its middle, y up).
        is_new_kind: whether the kind did not exist before.
        added: False when the look was known already.
    """

    knowledge: Knowledge
    kind: Kind
    centre_m: Array
    is_new_kind: bool
    added: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """One step of the question-and-answer dialogue; `choices` is empty where any text or number will do."""

    key: str
    text: str
    choices: tuple[str, ...] = ()


def teach(
    image: NDArray[Any], knowledge: Knowledge, *, kind: str, clicks_px: Sequence[tuple[float, float]],
    size_m: tuple[float, float] | None = None, plate_m: tuple[float, float] = PLATE_M, view: View | None = None,
    source: str = "",
) -> Lesson:  # fmt: skip
    """Teach that there is a `kind` at the clicked place.

    Args:
        clicks_px: one click in the middle (a known kind, or `size_m` given), or two on opposite corners, or three: two
            corners and the middle, where that is not half way.
        size_m: width and height on the plate; from the clicks or the kind if left out.
        source: a remark for the knowledge file.

    Raises:
        InvalidRequest: no or too many clicks, or no size for a new kind.
        NotFound: no plate, or the click is not on it.
        Ambiguous: the look would take examples away from another kind; says which.
    """
    if not 1 <= len(clicks_px) <= 3:
        raise InvalidRequest(f"{len(clicks_px)} clicks", hint="click the middle, or two opposite corners, or both")
    gray = as_gray(image)
    view = view or _plate_view(gray, plate_m)
    points_m = plate_points(view, clicks_px, plate_m)
    centre = points_m[0] if len(points_m) == 1 else points_m[:2].mean(axis=0) if len(points_m) == 2 else points_m[2]
    known = knowledge.kind(kind)
    if size_m is None and len(points_m) >= 2:
        size_m = (float(abs(points_m[0, 0] - points_m[1, 0])), float(abs(points_m[0, 1] - points_m[1, 1])))
    if size_m is None and known is None and kind != NOTHING:
        raise InvalidRequest(
            f"{kind!r} is a new kind and needs a size", hint="click two opposite corners, or give the size"
        )
    size_m = size_m or (known.size_m if known is not None else (0.010, 0.010))
    ground = lay_out(gray, view, plate_m)
    place = np.array([(centre[0] + plate_m[0] / 2), (plate_m[1] / 2 - centre[1])]) * PLATE_PX_PER_M
    place = _snapped(place, candidate_places(ground.edges))
    look = look_at(ground, place[None])[0]
    centre_m = np.array([place[0] / PLATE_PX_PER_M - plate_m[0] / 2, plate_m[1] / 2 - place[1] / PLATE_PX_PER_M])
    if known is not None and float(distances(look[None], _only(knowledge, known))[0, 0]) < SAME_LOOK:
        return Lesson(knowledge=knowledge, kind=known, centre_m=centre_m, is_new_kind=False, added=False)
    robbed = robbed_kinds(knowledge, kind, look)
    if robbed:
        raise Ambiguous(
            f"this {kind} looks so much like {', '.join(robbed)} that it would be taken for it",
            hint="take the image closer or with other light, or check what you clicked on",
            kinds=list(robbed),
        )
    grown = knowledge.with_look(kind, size_m, look, taught_by=source)
    made = grown.kind(kind)
    if made is None:
        raise AssertionError("a look was added to it")
    return Lesson(knowledge=grown, kind=made, centre_m=centre_m, is_new_kind=known is None, added=True)


def robbed_kinds(knowledge: Knowledge, kind: str, look: Array) -> tuple[str, ...]:
    """Kinds of which a taught look would be liker to the new look than to the rest of its own kind."""
    new = Kind(name=kind, size_m=(0.01, 0.01), looks=look[None])
    robbed = []
    for other in knowledge.kinds:
        if other.name == kind or len(other.looks) < 2:
            continue
        to_new = distances(other.looks, _only(knowledge, new))[:, 0]
        for k in np.flatnonzero(to_new < 0.5 * SAME_LOOK + 0.25):
            rest = Kind(name=other.name, size_m=other.size_m, looks=np.delete(other.looks, k, axis=0))
            if to_new[k] < float(distances(other.looks[k][None], _only(knowledge, rest))[0, 0]) and to_new[k] < 0.2:
                robbed.append(other.name)
                break
    return tuple(robbed)


def check(
    image: NDArray[Any], knowledge: Knowledge, *, plate_m: tuple[float, float] = PLATE_M, view: View | None = None
) -> tuple[Candidate, ...]:
    """What the system finds now: the objects first, then what it refuses and why."""
    return recognise(image, knowledge, plate_m=plate_m, view=view)


def questions(kind: str, knowledge: Knowledge) -> tuple[Question, ...]:
    """The dialogue for one clicked object: what must be known to write it into a panel file."""
    asked = [
        Question(
            key="kind",
            text="What kind of object is this?",
            choices=tuple(sorted({*OBJECT_KINDS, *(k.name for k in knowledge.kinds)} - {NOTHING})),
        )
    ]
    asked.append(Question(key="name", text="What is it called (a short name, lower case)?"))
    if kind in ("gauge", "panel_meter"):
        asked += [
            Question(key="minimum", text="Which value stands at the low end of the scale?"),
            Question(key="maximum", text="Which value stands at the high end?"),
            Question(key="unit", text="In which unit?"),
            Question(key="at_min", text="Pointer angle at the low end, radians clockwise from straight up?"),
            Question(key="at_max", text="Pointer angle at the high end?"),
        ]
    if kind == "display":
        asked += [
            Question(key="digits", text="How many digits?"),
            Question(key="decimals", text="How many after the point?"),
            Question(key="style", text="Glowing or dark segments?", choices=("led", "lcd")),
        ]
    if kind in ("rotary", "lever"):
        asked.append(
            Question(key="states", text="Its places: name=angle in radians clockwise from up, separated by commas?")
        )
    return tuple(asked)


def panel_text(
    name: str, plate_m: tuple[float, float], objects: Sequence[tuple[Candidate, Mapping[str, str]]], *,
    light_inset_m: float = 0.012,
) -> str:  # fmt: skip
    """TOML of a panel file from found objects and the answers about them.

    Raises:
        InvalidRequest: an answer is missing or no number; names object and question.
    """
    w, h = plate_m
    lines = [f'schema = 1\nname = "{name}"', f"width_m = {w:g}\nheight_m = {h:g}"]
    for corner, sx, sy in (
        ("upper_left", -1, 1),
        ("upper_right", 1, 1),
        ("lower_right", 1, -1),
        ("lower_left", -1, -1),
    ):
        x, y = sx * (w / 2 - light_inset_m), sy * (h / 2 - light_inset_m)
        lines.append(f'\n[[lights]]\nname = "light_{corner}"\nposition_m = [{x:.4f}, {y:.4f}, 0.0]')
    for candidate, answers in objects:
        lines.append(_object_text(candidate, answers))
    return "\n".join(lines) + "\n"


def plate_points(view: View, clicks_px: ArrayLike, plate_m: tuple[float, float]) -> Array:
    """(N, 2) plate points (m, origin in the middle, y up) under pixels.

    Raises:
        NotFound: a click lies beside the plate.
    """
    w, h = plate_m[0] / 2, plate_m[1] / 2
    corners = np.array([[-w, h], [w, h], [w, -h], [-w, -h]])
    plate_from_px = homography(view.project(np.column_stack([corners, np.zeros(4)])), corners)
    clicks = np.asarray(clicks_px, float)
    u = np.column_stack([clicks, np.ones(len(clicks))]) @ plate_from_px.T
    points = u[:, :2] / u[:, 2:]
    if (np.abs(points) > [w, h]).any():
        raise NotFound("a click lies beside the plate", hint="click on the object")
    return np.asarray(points)


def _plate_view(gray: NDArray[np.uint8], plate_m: tuple[float, float]) -> View:
    plate = find_plate(gray, *plate_m)
    if plate is None:
        raise NotFound(
            "no plate fills the image", hint="take an overview of one panel, upright, with its border in view"
        )
    return plate.view


def _snapped(place: Array, candidates: Array) -> Array:
    if not len(candidates):
        return place
    away = np.linalg.norm(candidates - place, axis=1)
    nearest = int(away.argmin())
    return np.asarray(candidates[nearest] if away[nearest] < SNAP_M * PLATE_PX_PER_M else place)


def _only(knowledge: Knowledge, kind: Kind) -> Knowledge:
    return Knowledge(kinds=(kind,), spread=knowledge.spread)


def _object_text(candidate: Candidate, answers: Mapping[str, str]) -> str:
    kind = answers.get("kind", candidate.kind)
    x, y = candidate.centre_m
    out = [
        f'\n[[objects]]\nkind = "{kind}"',
        f'name = "{_answer(answers, "name", kind)}"',
        f"position_m = [{x:.4f}, {y:.4f}]",
    ]
    across, along = (float(np.linalg.norm(candidate.box_px[k + 1] - candidate.box_px[k])) for k in (0, 1))
    ratio = along / max(across, 1e-9)
    width = float(answers.get("width_m", "0") or 0) or 0.06
    if kind in ("gauge", "lamp", "button", "rotary", "handwheel", "mushroom"):
        out.append(f"radius_m = {width / 2:.4f}")
    if kind in ("panel_meter", "display"):
        out += [f"width_m = {width:.4f}", f"height_m = {width * ratio:.4f}"]
    if kind == "panel_meter":
        out += [f"pivot_below_m = {0.25 * width * ratio:.4f}", f"needle_m = {0.55 * width * ratio:.4f}"]
    if kind == "display":
        out += [
            f"digits = {int(_number(answers, 'digits', kind))}",
            f"decimals = {int(_number(answers, 'decimals', kind))}",
            f'style = "{_answer(answers, "style", kind)}"',
        ]
    if kind in ("gauge", "panel_meter"):
        scale = ", ".join(
            f"{key} = {_number(answers, key, kind)!r}" for key in ("minimum", "maximum", "at_min", "at_max")
        )
        out.append(f'scale = {{ {scale}, unit = "{_answer(answers, "unit", kind)}" }}')
    if kind in ("rotary", "lever"):
        states = [part.split("=") for part in _answer(answers, "states", kind).split(",")]
        rows = ", ".join(f'{{ name = "{s.strip()}", angle_rad = {float(a)!r} }}' for s, a in states)
        out.append(f"states = [{rows}]")
    return "\n".join(out)


def _answer(answers: Mapping[str, str], key: str, kind: str) -> str:
    if key not in answers:
        raise InvalidRequest(f"no answer to {key!r} for a {kind}", hint="answer every question of the dialogue")
    return answers[key]


def _number(answers: Mapping[str, str], key: str, kind: str) -> float:
    text = _answer(answers, key, kind)
    try:
        return float(text)
    except ValueError:
        raise InvalidRequest(f"{key!r} of a {kind} must be a number, not {text!r}", hint="for example 10.0") from None
