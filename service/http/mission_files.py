"""`GET /v1/mission-files`: the missions that this cell can run, each with its steps or with what is wrong with it."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter
from pydantic import BaseModel, Field

from hal.config import Cell
from hal.errors import CellError
from service.http.problems import RESPONSES
from service.http.state import State
from service.missions.files import checked_file, mission_paths

router = APIRouter(prefix="/v1/mission-files", tags=["missions"], responses=RESPONSES)


class MissionFileView(BaseModel):
    """A mission file. `POST /v1/missions` runs it by its name, unless it has a `problem`."""

    name: str
    title: str = ""
    steps: Annotated[list[dict[str, Any]], Field(description="its steps, as the file has them")] = []
    problem: Annotated[str | None, Field(description="why it cannot be run on this panel; null if it can")] = None
    hint: Annotated[str, Field(description="what to do about the problem")] = ""


class MissionFileList(BaseModel):
    """The mission files of the cell, and those that are shipped, by name."""

    files: list[MissionFileView]


@router.get("", summary="Mission files that this cell can run", operation_id="list_mission_files")
async def list_mission_files(state: State) -> MissionFileList:
    cell = state.service.cell
    return MissionFileList(files=await state.in_thread(lambda: [_view(name, cell) for name in mission_paths(cell)]))


def _view(name: str, cell: Cell) -> MissionFileView:
    try:
        mission = checked_file(name, cell).mission
    except CellError as error:
        return MissionFileView(name=name, problem=error.what, hint=error.hint)
    plain = mission.model_dump(mode="json", exclude_none=True)
    return MissionFileView(name=name, title=mission.title, steps=plain["steps"])
