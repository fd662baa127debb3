"""The paper's question-and-answer sequence, which guides a person through teaching a kind or a whole panel.

The questions and the use of the answers are all here; `Talk` is a terminal, or a script in tests. An invalid answer
is explained and the question repeated; nothing is written before the last answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar

from hal.errors import CellError, InvalidRequest
from hal.panel import Question
from hal.panel.kinds import installed_kinds
from perception.vision.teaching import (
    Example,
    Overview,
    PanelObjectDraft,
    check,
    example_at,
    find_border_lights,
    kind_question,
    likest,
    object_row,
    panel_text,
    questions,
    teach_example,
)
from service.knowledge.store import KnowledgeStore, check_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from perception.vision import Knowledge
    from perception.vision.teaching import LightsFound

T = TypeVar("T")
MOST_TRIES = 5  # ends a script that repeats the same wrong answer
WHAT = Question(key="what", text="What do you teach?", choices=("kind", "panel"), default="kind")
WHERE = Question(key="where", text="Where is it (pixels: x,y of its middle, or of two opposite corners: x,y x,y)?")
MORE = Question(key="more", text="Is there another object?", choices=("no", "yes"), default="no")
IS_IT = Question(key="outline", text="Is that the object?", choices=("yes", "no"), default="yes")
PANEL_NAME = Question(key="panel", text="What is the panel called (small letters, digits, underscores)?")
LIGHTS = Question(
    key="lights", text="Where are the four border lights (x,y x,y x,y x,y; an empty answer finds them in the image)?"
)


class Talk(Protocol):
    """The interface to the person or script that answers."""

    def ask(self, question: Question) -> str:
        """Ask a question; returns the answer, stripped, or an empty text for none.

        Raises:
            InvalidRequest: there are no more answers.
        """
        ...

    def say(self, text: str) -> None:
        """Show a text."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dialogue:
    """One teaching session about one image."""

    talk: Talk
    store: KnowledgeStore
    pixels: NDArray[np.uint8]
    overview: Overview

    def run(self) -> None:
        """Ask the questions, teach, and show what is found afterwards."""
        what = self._until_good(lambda: self._answer(WHAT))
        if what == "kind":
            self._teach_kinds()
        else:
            self._teach_panel()

    def _teach_kinds(self) -> None:
        while True:
            example, knowledge = self._example()
            kind = self._until_good(partial(self._kind_name, example, knowledge))
            lesson = teach_example(example, knowledge, kind=kind, source="panelwright teach, dialogue")
            if lesson.added:
                self.talk.say(f"wrote {self.store.write_kind(lesson.kind)}")
            else:
                self.talk.say(f"this look of {kind} is known already; nothing was written")
            if self._until_good(lambda: self._answer(MORE)) == "no":
                break
        self.show_found()

    def _teach_panel(self) -> None:
        name = self._until_good(lambda: self._name(PANEL_NAME))
        lights = self._until_good(self._lights)
        drafts: list[PanelObjectDraft] = []
        while True:
            drafts.append(self._object({draft.name for draft in drafts}))
            if self._until_good(lambda: self._answer(MORE)) == "no":
                break
        text = panel_text(name, self.overview, lights, drafts)
        self.talk.say(f"wrote {self.store.write_panel(name, text)}")
        self._show_read(name)

    def _object(self, taken: set[str]) -> PanelObjectDraft:
        example, knowledge = self._example()
        seen = likest(self.overview, example, knowledge)
        suggested = seen.kind if seen is not None and seen.kind in installed_kinds() else ""
        question = Question(key="kind", text="What kind of object is it?", choices=installed_kinds(), default=suggested)
        kind = self._until_good(lambda: self._answer(question))
        name_question, *rest = questions(kind)

        def new_name() -> str:
            name = self._name(name_question)
            if name in taken:
                raise InvalidRequest(f"there is a {name!r} already", hint="give another name")
            return name

        name = self._until_good(new_name)
        answers: dict[str, str] = {}
        for asked in rest:
            answers[asked.key] = self._until_good(partial(self._object_answer, asked, kind, name, example, answers))
        return PanelObjectDraft(kind=kind, name=name, example=example, answers=answers)

    def _object_answer(
        self, question: Question, kind: str, name: str, example: Example, answers: dict[str, str]
    ) -> str:
        """Ask until the answer is valid together with the earlier ones."""
        given = self._answer(question)
        tried = {**answers, question.key: given}
        object_row(PanelObjectDraft(kind=kind, name=name, example=example, answers=tried), self.overview)
        return given

    def _example(self) -> tuple[Example, Knowledge]:
        while True:
            example = self._until_good(lambda: example_at(self.overview, points_of(self.talk.ask(WHERE))))
            knowledge = self.store.knowledge()
            self.talk.say(describe(self.overview, example, knowledge))
            if self._until_good(lambda: self._answer(IS_IT)) == "yes":
                return example, knowledge

    def _kind_name(self, example: Example, knowledge: Knowledge) -> str:
        seen = likest(self.overview, example, knowledge)
        known = kind_question(knowledge, seen.kind if seen is not None else "")
        text = f"What kind of object is this ({', '.join(known.choices)}; another name makes a new kind)?"
        return self._name(Question(key="kind", text=text, default=known.default))

    def _lights(self) -> LightsFound:
        found = find_border_lights(self.overview, points_of(self.talk.ask(LIGHTS), least=0))
        if not found.are_seen:
            self.talk.say("no border lights were found: measure their positions, because those in the file are guesses")
        return found

    def _name(self, question: Question) -> str:
        name = self._answer(question)
        if name in IS_IT.choices:  # an answer to the previous question, which must not become a kind
            raise InvalidRequest(f"{name!r} cannot be a name", hint="give the name of the kind or panel")
        check_name(name)
        return name

    def _answer(self, question: Question) -> str:
        given = self.talk.ask(question) or question.default
        if question.choices and given not in question.choices:
            raise InvalidRequest(
                f"{given[:40]!r} is not one of the choices", hint=f"one of: {', '.join(question.choices)}"
            )
        return given

    def _until_good(self, step: Callable[[], T]) -> T:
        """Repeat a step until its answer is valid."""
        for _ in range(MOST_TRIES - 1):
            try:
                return step()
            except CellError as error:
                if isinstance(error, NobodyAnswers):
                    raise
                self.talk.say(f"{error.what}; {error.hint}")
        return step()

    def show_found(self) -> None:
        """Show what is found in the image with the present knowledge."""
        lines = []
        for found in check(self.pixels, self.store.knowledge(), plate_m=self.overview.plate_m, view=self.overview.view):
            x, y = found.centre_px
            verdict = f"refused: {found.reason}" if found.reason else f"confidence {found.confidence:.2f}"
            lines.append(f"{found.kind} at {x:.0f},{y:.0f} px  {verdict}")
        for line in dict.fromkeys(lines):  # two rejected candidates may give the same text
            self.talk.say(line)

    def _show_read(self, name: str) -> None:
        from perception.vision import as_gray, inspect_view, said

        panel = self.store.panel(name)
        for reading in inspect_view(self.pixels, as_gray(self.pixels), self.overview.view, panel):
            self.talk.say(f"{reading.name} ({reading.kind}): {reading.reason or said(reading)}")


class NobodyAnswers(InvalidRequest):
    """The answers ended before the questions."""


def describe(overview: Overview, example: Example, knowledge: Knowledge) -> str:
    """Describe in one sentence what was found at the clicks."""
    shape = example.outline.shape if example.outline is not None else "place"
    width, height = (1e3 * side for side in example.size_m)
    x, y = overview.in_image(example.centre_m[None])[0]
    taken = likest(overview, example, knowledge)
    words = "no known kind looks like it"
    if taken is not None:
        doubt = " (not certain)" if taken.reason else ""
        words = f"recognised as {taken.kind}, confidence {taken.confidence:.2f}{doubt}"
    return f"found a {shape} of {width:.0f} x {height:.0f} mm about {x:.0f},{y:.0f} px; {words}"


def points_of(text: str, *, least: int = 1) -> tuple[tuple[float, float], ...]:
    """Read pixel coordinates from text such as "x,y x,y".

    Raises:
        InvalidRequest: the text has no numbers, or too few.
    """
    try:
        pairs = [tuple(float(part) for part in item.split(",")) for item in text.split()]
        points = tuple((x, y) for x, y in pairs)
    except ValueError:
        raise InvalidRequest(f"{text[:40]!r} is not pixels", hint="for example 320,240 or 300,200 340,280") from None
    if not all(abs(x) < 1e6 and abs(y) < 1e6 for x, y in points):  # false for NaN too
        raise InvalidRequest("a pixel is out of range", hint="give finite numbers inside the image")
    if len(points) < least:
        raise InvalidRequest("no pixel was given", hint="for example 320,240")
    return points
