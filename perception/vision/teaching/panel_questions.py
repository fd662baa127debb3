"""What must be asked about each object of a new panel; every question has an answer that stands when nothing is said."""

from __future__ import annotations

from dataclasses import dataclass

from hal.errors import InvalidRequest
from hal.panel import OBJECT_KINDS
from perception.vision.knowledge import NOTHING, Knowledge

COLOURS = ("green", "red", "amber", "blue", "white")


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """One step of the dialogue; `choices` is empty where any text or number will do. `default` stands if unanswered."""

    key: str
    text: str
    choices: tuple[str, ...] = ()
    default: str = ""


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
