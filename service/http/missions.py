"""`GET /v1/missions`: reports of finished missions. (The verb of the same name starts one.)"""

from __future__ import annotations

import re
from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Path
from starlette.responses import FileResponse

from service.errors import NoSuchMission
from service.http.models import MissionList, MissionView
from service.http.problems import RESPONSES
from service.http.state import State
from service.missions.earlier import Told, told_of

router = APIRouter(prefix="/v1/missions", tags=["missions"], responses=RESPONSES)
PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
MAX_MISSIONS = 200


@router.get("", summary="Missions with reports, newest first", operation_id="list_missions")
async def list_missions(state: State) -> MissionList:
    return MissionList(missions=await state.in_thread(lambda: _missions(state.service.runs_dir)))


@router.get(
    "/{mission}/{name}",
    summary="A file of a mission: report.html, report.json or a picture",
    operation_id="fetch_mission_file",
    response_class=FileResponse,
    responses={200: {"content": {"application/octet-stream": {}, "text/html": {}, "application/json": {}}}},
)
async def fetch_mission_file(
    state: State,
    mission: Annotated[str, Path(max_length=100, examples=["2026-11-20T23-15-02"])],
    name: Annotated[str, Path(max_length=100, examples=["report.html"])],
) -> FileResponse:
    root = state.service.runs_dir.resolve()
    path = (root / mission / name).resolve() if PLAIN.fullmatch(mission) and PLAIN.fullmatch(name) else None
    if path is None or path.parent.parent != root or not path.is_file():
        raise NoSuchMission("there is no such mission, or it has no such file", hint="GET /v1/missions lists them")
    # Reports contain their own styles and pictures and run no scripts.
    policy = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline' 'self'; frame-ancestors 'none'"
    return FileResponse(path, headers={"Content-Security-Policy": policy, "Cache-Control": "no-store"})


def _missions(runs_dir: FilePath) -> list[MissionView]:
    if not runs_dir.is_dir():
        return []
    folders = [path for path in runs_dir.iterdir() if path.is_dir() and PLAIN.fullmatch(path.name)]
    done = [(told_of(path), path) for path in folders if (path / "report.json").is_file()]
    newest = sorted(done, key=lambda pair: (pair[0].started, pair[1]), reverse=True)[:MAX_MISSIONS]
    return [_mission(path, told) for told, path in newest]


def _mission(path: FilePath, told: Told) -> MissionView:
    files = sorted(item.name for item in path.iterdir() if item.is_file() and PLAIN.fullmatch(item.name))
    base = f"/v1/missions/{path.name}"
    return MissionView(
        name=path.name,
        started=told.started or None,
        title=told.title,
        succeeded=told.succeeded,
        objects=list(told.objects),
        unfinished_step=told.unfinished_step,
        report_url=f"{base}/report.html" if "report.html" in files else None,
        json_url=f"{base}/report.json" if "report.json" in files else None,
        files=files,
    )
