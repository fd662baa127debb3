"""`/v1/calibrations`: the records in use, with origin and quality. `POST` is the verb of the same name."""

from __future__ import annotations

import functools
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from pydantic import BaseModel, Field

from service.http.problems import RESPONSES
from service.http.state import Admitted, AppState, State
from service.knowledge.calibrations import Calibrated

router = APIRouter(prefix="/v1/calibrations", tags=["calibrations"], responses=RESPONSES)
DeviceName = Annotated[str, Path(max_length=64, examples=["wrist_camera"])]


class CalibrationView(BaseModel):
    """A calibration record in use. `is_measured` is false for the cell file's own record."""

    device: str
    parent: Annotated[str, Field(description="frame that the device is mounted on")]
    is_measured: bool
    version: int
    date: str
    method: str
    mount: dict[str, Any] | None
    intrinsics: dict[str, Any] | None
    load: dict[str, Any] | None
    quality: Annotated[dict[str, float], Field(description="quality figures of the method, SI units")]
    older: Annotated[list[str], Field(description="earlier records, oldest first, which are kept")]
    path: str
    toml: str | None = None


class CalibrationList(BaseModel):
    """The calibrations in use, one per mounted device."""

    calibrations: list[CalibrationView]


@router.get("", summary="Calibrations in use", operation_id="list_calibrations")
async def list_calibrations(
    state: State, toml: Annotated[bool, Query(description="include the text of the records")] = False
) -> CalibrationList:
    return CalibrationList(calibrations=await state.in_thread(functools.partial(_all, state, with_text=toml)))


@router.get("/{name}", summary="The calibration of one device, with its TOML", operation_id="show_calibration")
async def show_calibration(state: State, name: DeviceName) -> CalibrationView:
    return _view(await state.in_thread(functools.partial(state.service.calibrations.of, name)), with_text=True)


@router.delete(
    "/{name}",
    status_code=204,
    summary="Use the cell file's own record again; the measured one is kept among the older ones",
    operation_id="forget_calibration",
)
async def forget_calibration(state: State, _holder: Admitted, name: DeviceName) -> None:
    await state.in_thread(functools.partial(state.service.calibrations.forget, name))
    await state.commit("calibration-forgotten", {"device": name})


def _all(state: AppState, *, with_text: bool) -> list[CalibrationView]:
    return [_view(entry, with_text=with_text) for entry in state.service.calibrations.all()]


def _view(entry: Calibrated, *, with_text: bool) -> CalibrationView:
    from perception.calibration import to_toml

    record = entry.record.model_dump(mode="json", by_alias=True)
    return CalibrationView(
        device=entry.device,
        parent=entry.parent,
        is_measured=entry.is_measured,
        older=[path.name for path in entry.older],
        path=str(entry.path),
        toml=to_toml(entry.record) if with_text else None,
        **{key: record[key] for key in ("version", "date", "method", "mount", "intrinsics", "load", "quality")},
    )
