"""`/v1/knowledge`: the known kinds and panels, and how users add to them."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Annotated, Literal, TypeVar

from fastapi import APIRouter, Path, Query
from fastapi import Depends as DependsOn
from pydantic import BaseModel, Field

from hal.panel import Panel, load_panel
from hal.toml_text import toml_text
from service.http.body import body_schema, strict_body
from service.http.images import store_of
from service.http.problems import RESPONSES
from service.http.state import Admitted, AppState, State
from service.knowledge.store import KnowledgeFile, KnowledgeStore, NoSuchKnowledge
from service.knowledge.teach import (
    OutlineRequest,
    OutlineView,
    TaughtView,
    TeachRequest,
    find_outline,
    questions_of,
    teach,
)

router = APIRouter(prefix="/v1/knowledge", tags=["knowledge"], responses=RESPONSES)
PlainName = Annotated[str, Path(max_length=64, examples=["mushroom"])]
EXAMPLE_ID = "3f9c2a7be01d4c553f9c2a7b"
OUTLINE_EXAMPLE = {"image": EXAMPLE_ID, "plate_m": [0.6, 0.4], "clicks_px": [[1047.0, 674.0]]}
TEACH_EXAMPLE = {**OUTLINE_EXAMPLE, "kind": "mushroom"}


class KindView(BaseModel):
    """A kind of object; `is_taught` is false for a shipped kind."""

    name: str
    is_taught: bool
    width_m: float
    height_m: float
    looks: Annotated[int, Field(description="number of examples")]
    toml: str | None = None


class ObjectView(BaseModel):
    """An object of a known panel."""

    panel: str
    name: str
    kind: str
    position_m: Annotated[list[float], Field(description="x, y on the plate, from its middle, y up")]


class PanelView(BaseModel):
    """A known panel; `is_taught` is false for the panel of the cell file."""

    name: str
    is_taught: bool
    width_m: float
    height_m: float
    objects: list[str]
    toml: str | None = None


class KnowledgeView(BaseModel):
    """All known kinds, objects and panels."""

    kinds: list[KindView]
    objects: list[ObjectView]
    panels: list[PanelView]


class QuestionView(BaseModel):
    """A question of the dialogue; `choices` is empty if any text or number is a possible answer."""

    key: str
    text: str
    choices: list[str]
    default: str


class QuestionList(BaseModel):
    """The questions about one clicked object."""

    kind: str
    questions: list[QuestionView]


V = TypeVar("V", KindView, PanelView)


@router.get("", summary="Kinds, objects and panels, with their TOML", operation_id="list_knowledge")
async def list_knowledge(
    state: State, toml: Annotated[bool, Query(description="include the text of the files")] = True
) -> KnowledgeView:
    return await state.in_thread(functools.partial(_knowledge, state, with_text=toml))


@router.get("/questions", summary="Questions of the dialogue about an object of a kind", operation_id="list_questions")
async def list_questions(
    kind: Annotated[str, Query(max_length=41, description="kind of the object", examples=["gauge"])],
) -> QuestionList:
    asked = [
        QuestionView(key=q.key, text=q.text, choices=list(q.choices), default=q.default) for q in questions_of(kind)
    ]
    return QuestionList(kind=kind, questions=asked)


@router.post(
    "/outline",
    summary="Find the object at one to three clicks in a stored image; writes nothing",
    operation_id="find_outline",
    openapi_extra=body_schema(OutlineRequest, OUTLINE_EXAMPLE, required=True),
)
async def outline(
    state: State, request: Annotated[OutlineRequest, DependsOn(strict_body(OutlineRequest))]
) -> OutlineView:
    return await state.in_thread(functools.partial(find_outline, store_of(state), _store(state), request))


@router.post(
    "/teach",
    summary="Teach a kind by clicks, or a whole panel by clicks and answers",
    operation_id="teach",
    openapi_extra=body_schema(TeachRequest, TEACH_EXAMPLE, required=True),
)
async def teach_something(
    state: State, _holder: Admitted, request: Annotated[TeachRequest, DependsOn(strict_body(TeachRequest))]
) -> TaughtView:
    taught = await state.in_thread(functools.partial(teach, store_of(state), _store(state), request))
    await state.commit("taught", {"what": taught.what, "name": taught.name, "added": taught.added})
    return taught


@router.get("/kinds/{name}", summary="One kind, with its TOML", operation_id="show_kind")
async def show_kind(state: State, name: PlainName) -> KindView:
    kinds = (await state.in_thread(functools.partial(_knowledge, state, with_text=True))).kinds
    return _named(kinds, name)


@router.get("/panels/{name}", summary="One panel, with its TOML", operation_id="show_panel_knowledge")
async def show_panel_knowledge(state: State, name: PlainName) -> PanelView:
    panels = (await state.in_thread(functools.partial(_knowledge, state, with_text=True))).panels
    return _named(panels, name)


@router.delete(
    "/{group}/{name}", status_code=204, summary="Forget a taught kind or panel", operation_id="forget_knowledge"
)
async def forget(state: State, _holder: Admitted, group: Literal["kinds", "panels"], name: PlainName) -> None:
    await state.in_thread(functools.partial(_store(state).forget, group, name))
    await state.commit("knowledge-forgotten", {"group": group, "name": name})


def _named(known: Sequence[V], name: str) -> V:
    for view in known:
        if view.name == name:
            return view
    raise NoSuchKnowledge("there is no kind or panel of that name", hint="GET /v1/knowledge lists what is known")


def _store(state: AppState) -> KnowledgeStore:
    return KnowledgeStore.of_runs(state.service.runs_dir, state.service.cell)


def _knowledge(state: AppState, *, with_text: bool) -> KnowledgeView:
    store, cell = _store(state), state.service.cell
    panels = [(cell.panel, False, _text_of(cell.panel) if with_text else None)]
    panels += [(load_panel(file.path), True, file.text() if with_text else None) for file in store.panels()]
    return KnowledgeView(
        kinds=[_kind(file, with_text=with_text) for file in store.kinds()],
        objects=[
            ObjectView(
                panel=panel.name,
                name=panel_object.name,
                kind=panel_object.kind,
                position_m=list(panel_object.position_m),
            )
            for panel, _, _ in panels
            for panel_object in panel.objects
        ],
        panels=[
            PanelView(
                name=panel.name,
                is_taught=is_taught,
                width_m=panel.width_m,
                height_m=panel.height_m,
                objects=[panel_object.name for panel_object in panel.objects],
                toml=text,
            )
            for panel, is_taught, text in panels
        ],
    )


def _text_of(panel: Panel) -> str:
    """Return the cell's panel as the text of a panel file, including default values."""
    return toml_text(panel.model_dump(mode="json", by_alias=True, exclude_none=True))


def _kind(file: KnowledgeFile, *, with_text: bool) -> KindView:
    summary = file.summary()
    return KindView(
        name=file.name,
        is_taught=file.is_taught,
        width_m=summary.width_m,
        height_m=summary.height_m,
        looks=summary.looks,
        toml=file.text() if with_text else None,
    )
