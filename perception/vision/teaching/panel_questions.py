"""Questions about each object of a new panel; every question has an answer that holds if the user gives none."""

from __future__ import annotations

from hal.errors import InvalidRequest
from hal.panel import Question
from hal.panel.kinds import installed_kinds, kind_model
from perception.vision.knowledge import NOTHING, Knowledge

NAME = Question(key="name", text="What is it called (a short name: small letters, digits, underscores)?")


def kind_question(knowledge: Knowledge, suggested: str = "") -> Question:
    """Return the first question about a clicked object, that for its kind."""
    known = sorted({*installed_kinds(), *(kind.name for kind in knowledge.kinds)} - {NOTHING})
    return Question(key="kind", text="What kind of object is this?", choices=tuple(known), default=suggested)


def questions(kind: str) -> tuple[Question, ...]:
    """Return the questions whose answers are needed to write a clicked object into a panel file.

    Raises:
        InvalidRequest: panel files have no such kind.
    """
    if kind not in installed_kinds():
        raise InvalidRequest(
            f"a panel file knows no {kind!r}: a kind without a model can be found, not read",
            hint=f"kinds of a panel file: {', '.join(installed_kinds())}",
        )
    return (NAME, *kind_model(kind).asked)
