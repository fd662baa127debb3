"""`/v1/mission-files`: the missions that this cell can run, each with its steps or with what is wrong with it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path
from pydantic import BaseModel, Field
from starlette.responses import Response

from hal.config import Cell
from hal.errors import CellError
from hal.strict import Strict
from service.http.body import body_schema, strict_body
from service.http.problems import RESPONSES
from service.http.state import State
from service.missions.check import Checked
from service.missions.files import checked_file, checked_text, digest_of, mission_paths, mission_text, store_mission
from service.schema.mission_file import MissionName

router = APIRouter(prefix="/v1/mission-files", tags=["missions"], responses=RESPONSES)
Name = Annotated[str, Path(alias="mission", pattern=r"^[a-z][a-z0-9_-]{0,60}$", examples=["inspect"])]
Text = Annotated[str, Field(max_length=100_000, description="the whole file, in TOML")]
EXAMPLE = {"text": 'title = "Look"\n[[steps]]\nkind = "inspect"\nname = "read"\n'}


class MissionFileView(BaseModel):
    """A mission file. `POST /v1/missions` runs it by its name, unless it has a `problem`."""

    name: str
    title: str = ""
    steps: Annotated[list[dict[str, Any]], Field(description="its steps, as the file has them")] = []
    problem: Annotated[str | None, Field(description="why it cannot be run on this panel; null if it can")] = None
    hint: Annotated[str, Field(description="what to do about the problem")] = ""
    faults: Annotated[list[str], Field(description="all faults, each with its key and remedy")] = []


class MissionFileText(BaseModel):
    """The text of a mission file."""

    name: str
    text: str
    digest: Annotated[str, Field(description="SHA-256 of the text; `replaces` of PUT")]
    is_shipped: Annotated[bool, Field(description="it belongs to the package; PUT stores one that takes its place")]


class MissionDraft(Strict):
    """A mission that is to be checked; `name` is the one under which it would be stored."""

    text: Text
    name: MissionName = "draft"


class MissionToStore(Strict):
    """A mission file to store."""

    text: Text
    replaces: Annotated[
        str | None,
        Field(pattern="^[0-9a-f]{64}$", description="digest of the text that it replaces; null for a new one"),
    ] = None


STORING = threading.Lock()  # two who save at once must not both replace the same text
BODIES = (MissionDraft, MissionToStore)


class MissionFileList(BaseModel):
    """The mission files of the cell, and those that are shipped, by name."""

    files: list[MissionFileView]


@router.get("", summary="Mission files that this cell can run", operation_id="list_mission_files")
async def list_mission_files(state: State) -> MissionFileList:
    cell = state.service.cell
    return MissionFileList(files=await state.in_thread(lambda: [_view(name, cell) for name in mission_paths(cell)]))


@router.get("/{mission}", summary="The text of a mission file", operation_id="show_mission_file")
async def show_mission_file(state: State, name: Name) -> MissionFileText:
    found = await state.in_thread(lambda: mission_text(name, state.service.cell))
    return MissionFileText(name=name, text=found.text, digest=found.digest, is_shipped=found.is_shipped)


@router.post(
    "/check",
    summary="Check a mission against the panel; nothing is stored",
    operation_id="check_mission_file",
    openapi_extra=body_schema(MissionDraft, EXAMPLE, required=True),
)
async def check_mission_file(
    state: State, draft: Annotated[MissionDraft, Depends(strict_body(MissionDraft))]
) -> MissionFileView:
    cell = state.service.cell
    return await state.in_thread(lambda: _told(draft.name, lambda: checked_text(draft.name, draft.text, cell)))


@router.put(
    "/{mission}",
    summary="Store a mission file of the cell, after it was checked",
    operation_id="store_mission_file",
    status_code=204,
    openapi_extra=body_schema(MissionToStore, EXAMPLE, required=True),
)
async def store_mission_file(
    state: State, name: Name, body: Annotated[MissionToStore, Depends(strict_body(MissionToStore))]
) -> Response:
    service = state.service
    told = {"mission": name, "digest": digest_of(body.text), "replaces": body.replaces}

    def store() -> None:
        with STORING:
            store_mission(
                name,
                body.text,
                service.cell,
                replaces=body.replaces,
                commit=lambda path: service.commit("mission-stored", {**told, "path": str(path)}),
            )

    await state.act(store)
    return Response(status_code=204)


def _view(name: str, cell: Cell) -> MissionFileView:
    return _told(name, lambda: checked_file(name, cell))


def _told(name: str, check: Callable[[], Checked]) -> MissionFileView:
    try:
        mission = check().mission
    except CellError as error:
        faults = error.details.get("faults", [error.what])
        return MissionFileView(name=name, problem=error.what, hint=error.hint, faults=faults)
    plain = mission.model_dump(mode="json", exclude_none=True)
    return MissionFileView(name=name, title=mission.title, steps=plain["steps"])
