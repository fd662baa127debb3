"""Teaches from an image: a kind by clicks, or a whole panel by clicks and answers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from hal.errors import InvalidRequest
from hal.panel import Panel, Question
from hal.strict import Strict
from service.knowledge.images import ImageStore
from service.knowledge.store import KnowledgeStore, check_name
from service.schema.requests import ImageId, ObjectName, Pixel, PlateCorners, PlateSize
from service.schema.results import LearnResult, Numbers, Result, Rows

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from perception.vision import PanelProjection
    from perception.vision.teaching import Example, Overview, PanelLooks

Clicks = Annotated[tuple[Pixel, ...], Field(min_length=1, max_length=3)]
PlainName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
Answer = Annotated[str, Field(max_length=400)]


class OutlineRequest(Strict):
    """Clicks on one object: its middle, two opposite corners, or two corners and the middle."""

    image: ImageId
    plate_m: Annotated[PlateSize, Field(description="width and height of the panel's plate")]
    corners_px: PlateCorners | None = None
    clicks_px: Clicks


class ObjectLesson(Strict):
    """One object of a new panel: its clicks, and the answers to GET /v1/knowledge/questions."""

    kind: ObjectName
    name: PlainName
    clicks_px: Clicks
    answers: Annotated[dict[ObjectName, Answer], Field(max_length=20)] = {}


class PanelLesson(Strict):
    """A whole new panel. Without `lights_px` the four border lights are searched for in the corners."""

    name: PlainName
    objects: Annotated[tuple[ObjectLesson, ...], Field(min_length=1, max_length=100)]
    lights_px: Annotated[tuple[Pixel, ...], Field(max_length=4)] = ()


class TeachRequest(Strict):
    """Teach a kind (`kind` and `clicks_px`) or a whole panel (`panel`) from a stored image."""

    image: ImageId
    plate_m: Annotated[PlateSize, Field(description="width and height of the panel's plate")]
    corners_px: PlateCorners | None = None
    kind: Annotated[PlainName | None, Field(description="a new name makes a new kind")] = None
    clicks_px: Annotated[tuple[Pixel, ...], Field(max_length=3)] = ()
    size_m: Annotated[PlateSize | None, Field(description="size of the kind; if null, the size of the outline")] = None
    panel: PanelLesson | None = None

    @model_validator(mode="after")
    def _is_one_lesson(self) -> TeachRequest:
        if (self.kind is None) == (self.panel is None):
            raise ValueError("give either `kind` with `clicks_px`, or `panel`")
        if self.kind is not None and not self.clicks_px:
            raise ValueError("a kind needs one to three clicks")
        if self.panel is not None and (self.clicks_px or self.size_m):
            raise ValueError("clicks_px and size_m belong to a kind; a panel's objects have their own")
        return self


class OutlineView(Result):
    """The outline found at the clicks, and the kind that it is recognised as."""

    shape: str
    outline_px: Rows
    centre_px: Numbers
    centre_m: Numbers
    size_m: Numbers
    taken_for: str | None
    confidence: float | None
    reason: str | None


class TaughtView(Result):
    """What was stored. `added` is false if the look was known already and nothing was written."""

    what: Literal["kind", "panel"]
    name: str
    added: bool
    is_new: bool
    path: str | None
    toml: str
    outline: OutlineView | None = None
    lights_are_seen: bool | None = None


def questions_of(kind: str) -> tuple[Question, ...]:
    """Return the questions of the dialogue about an object of this kind."""
    from perception.vision.teaching import questions

    return questions(kind)


def find_outline(images: ImageStore, store: KnowledgeStore, request: OutlineRequest) -> OutlineView:
    """Find the outline at the clicks and classify it; writes nothing.

    Raises:
        NoSuchImage, InvalidRequest, NotObservable, NotFound, Ambiguous: there is no usable outline.
    """
    from perception.vision.teaching import example_at, overview_of

    overview = overview_of(images.pixels(request.image), plate_m=request.plate_m, corners_px=request.corners_px)
    return described(overview, example_at(overview, request.clicks_px), store)


def teach(images: ImageStore, store: KnowledgeStore, request: TeachRequest) -> TaughtView:
    """Teach what the request describes and store it.

    Raises:
        PerceptionError: as for `find_outline`; `Ambiguous` also when the lesson would make another kind worse.
        ConfigError: the answers do not make a valid panel.
    """
    from perception.vision.teaching import overview_of

    overview = overview_of(images.pixels(request.image), plate_m=request.plate_m, corners_px=request.corners_px)
    if request.panel is not None:
        return teach_panel(store, overview, request.panel)
    return teach_kind(store, overview, kind=request.kind or "", clicks_px=request.clicks_px, size_m=request.size_m)


def teach_kind(
    store: KnowledgeStore,
    overview: Overview,
    *,
    kind: str,
    clicks_px: tuple[Pixel, ...],
    size_m: tuple[float, float] | None = None,
) -> TaughtView:
    """Teach one example of a kind and store it; see `teach`."""
    from perception.vision.teaching import example_at

    check_name(kind)
    example = example_at(overview, clicks_px, kind=kind)
    taught = _stored(store, example, kind=kind, size_m=size_m, source="panelwright teach")
    return (
        taught
        if example.outline is None
        else taught.model_copy(update={"outline": described(overview, example, store)})
    )


def teach_surroundings(store: KnowledgeStore, picture: bytes, *, kind: str) -> TaughtView:
    """Teach the look of the object in the middle of its surroundings, which the history keeps of a doubted reading.

    Raises:
        PerceptionError: as for `teach`.
    """
    from perception.vision import decode
    from perception.vision.teaching import example_in

    return _stored(store, example_in(decode(picture)), kind=kind, source="panelwright review")


def _stored(
    store: KnowledgeStore, example: Example, *, kind: str, source: str, size_m: tuple[float, float] | None = None
) -> TaughtView:
    from perception.vision.teaching import teach_example

    lesson = teach_example(example, store.knowledge(), kind=kind, size_m=size_m, source=source)
    path = store.write_kind(lesson.kind) if lesson.added else None
    file = next(file for file in store.kinds() if file.name == kind)
    return TaughtView(
        what="kind",
        name=kind,
        added=lesson.added,
        is_new=lesson.is_new_kind,
        path=None if path is None else str(path),
        toml=file.text(),
    )


def teach_panel(store: KnowledgeStore, overview: Overview, lesson: PanelLesson) -> TaughtView:
    """Write a whole panel's file from clicks and answers; see `teach`."""
    from perception.vision.teaching import PanelObjectDraft, example_at, find_border_lights, panel_text

    check_name(lesson.name)
    lights = find_border_lights(overview, lesson.lights_px)
    drafts = [
        PanelObjectDraft(
            kind=panel_object.kind,
            name=panel_object.name,
            example=example_at(overview, panel_object.clicks_px),
            answers=panel_object.answers,
        )
        for panel_object in lesson.objects
    ]
    text = panel_text(lesson.name, overview, lights, drafts)
    is_new = lesson.name not in {file.name for file in store.panels()}
    return TaughtView(
        what="panel",
        name=lesson.name,
        added=True,
        is_new=is_new,
        path=str(store.write_panel(lesson.name, text)),
        toml=text,
        lights_are_seen=lights.are_seen,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Learned:
    """The examples learned from an overview of a known panel, and the files of the kinds that were changed."""

    panel: str
    looks: PanelLooks
    files: tuple[Path, ...]

    def result(self) -> LearnResult:
        """Return the result as an API answer: objects by name, examples by kind."""
        return LearnResult(
            panel=self.panel,
            added=self.looks.added,
            taught_by=[each.panel_object.name for each in self.looks.shown],
            left_out=self.looks.left_out,
            known_before=list(self.looks.known_before),
            known_now=list(self.looks.known_now),
            files=[str(path) for path in self.files],
        )


def learn_panel(store: KnowledgeStore, pixels: NDArray[np.uint8], view: PanelProjection, panel: Panel) -> Learned:
    """Learn the appearance of a known panel's objects from one overview and store it.

    Raises:
        InvalidRequest, NotObservable, NotFound, Ambiguous: nothing can be learned from the overview.
    """
    from perception.vision.teaching import teach_from_panel

    looks = teach_from_panel(pixels, view, panel, store.knowledge(), source="panelwright learn")
    return Learned(panel=panel.name, looks=looks, files=tuple(store.write_kind(kind) for kind in looks.kinds))


def described(overview: Overview, example: Example, store: KnowledgeStore) -> OutlineView:
    """Return an example's outline in the image and its present classification, for display."""
    from perception.vision.teaching import likest

    if example.outline is None:
        raise InvalidRequest("there are no clicks", hint="click on an object")
    taken = likest(overview, example, store.knowledge())
    return OutlineView(
        shape=example.outline.shape,
        outline_px=example.outline_px.tolist(),
        centre_px=overview.in_image(example.centre_m[None])[0].tolist(),
        centre_m=example.centre_m.tolist(),
        size_m=list(example.size_m),
        taken_for=None if taken is None else taken.kind,
        confidence=None if taken is None else taken.confidence,
        reason=None if taken is None else taken.reason,
    )
