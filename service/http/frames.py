"""`/v1/frames` and `/v1/panel`: the known frames, and the panel file."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import APIRouter

from hal.errors import CellError
from hal.geometry import UncertainPose, certain, to_json
from service.core import Service
from service.http.models import FrameList, FrameView
from service.http.problems import RESPONSES
from service.http.state import State

router = APIRouter(prefix="/v1", tags=["knowledge"], responses=RESPONSES)


@router.get("/frames", summary="Poses of the devices, the flange and the panel", operation_id="list_frames")
async def list_frames(state: State) -> FrameList:
    return FrameList(frames=await state.in_thread(lambda: _frames(state.service)))


@router.get("/panel", summary="The panel file, with the limits that people have set", operation_id="show_panel")
async def show_panel(state: State) -> dict[str, Any]:
    return state.service.plant.panel.model_dump(mode="json", by_alias=True)


def _frames(service: Service) -> list[FrameView]:
    frames = []
    cell = service.calibrations.applied()
    for name, section in cell.file.devices.items():
        if section.mount is None:
            continue
        mount = cell.calibrations[section.mount.calibration].mount
        if mount is not None:
            frames.append(_frame(section.mount.parent, name, mount.pose(), "calibration"))
    try:
        flange = service.supervisor.connection.mover.state().base_from_flange
        frames.append(_frame("base", "flange", certain(flange), "measured"))
    except CellError:
        pass  # without a readable arm the pose of the flange is not known
    panel = service.world.base_from_panel
    if panel is not None:
        frames.append(_frame("base", "panel", panel, "estimated"))
    return frames


def _frame(
    parent: str, child: str, pose: UncertainPose, source: Literal["calibration", "measured", "estimated"]
) -> FrameView:
    covariance = None if source == "measured" else [[float(v) for v in row] for row in pose.covariance]
    return FrameView(
        parent=parent, child=child, **to_json(pose.parent_from_child), covariance=covariance, source=source
    )
