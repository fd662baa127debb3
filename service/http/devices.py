"""`/v1/devices`: health, newest readings, exchange of drivers at run time, and faults of simulated devices."""

from __future__ import annotations

import functools
from enum import StrEnum
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from fastapi import Depends as DependsOn
from starlette.responses import JSONResponse, Response

from hal.errors import CellError, InvalidRequest, Unsupported
from service.core import Service
from service.errors import NoSuchDevice
from service.http.body import body_schema, strict_body
from service.http.models import DeviceDetail, DeviceList, DeviceView, FaultRequest, HealthView, ReadingView, SwapRequest
from service.http.problems import RESPONSES
from service.http.state import Admitted, AppState, State
from service.http.swap_files import with_recordings
from service.jsonable import jsonable
from service.processes.connection import check_name
from service.readings import as_json

router = APIRouter(prefix="/v1/devices", tags=["devices"], responses=RESPONSES)
Name = Annotated[str, Path(max_length=64, examples=["wrist_camera"])]
SECRET = ("password", "token", "key", "secret")


class Format(StrEnum):
    """Formats of a reading."""

    JSON = "json"
    PNG = "png"
    NPZ = "npz"


@router.get("", summary="All devices with their health", operation_id="list_devices")
async def list_devices(state: State) -> DeviceList:
    names = list(state.service.cell.file.devices)
    return DeviceList(devices=await state.in_thread(lambda: [_view(state.service, name) for name in names]))


@router.get("/{name}", summary="One device with capabilities and mount", operation_id="show_device")
async def show_device(state: State, name: Name) -> DeviceDetail:
    _check(state, name)
    return await state.in_thread(functools.partial(_detail, state.service, name))


@router.get(
    "/{name}/reading",
    summary="The newest reading: JSON, or PNG and npz for images and ranges",
    operation_id="read_device",
    response_model=ReadingView,
    responses={200: {"content": {"image/png": {}, "application/octet-stream": {}}}},
)
async def read_device(
    state: State,
    name: Name,
    form: Annotated[Format, Query(alias="format")] = Format.JSON,
    max_age_s: Annotated[
        float,
        Query(
            ge=0.0,
            le=60.0,
            allow_inf_nan=False,
            description="return the stored reading if it is at most this old, instead of reading again",
        ),
    ] = 0.0,
) -> Response:
    _check(state, name)
    desk = state.readings
    headers = {"Cache-Control": "no-store"}
    if form is Format.PNG:
        png = await state.in_thread(functools.partial(desk.png, name, max_age_s=max_age_s))
        return Response(png, media_type="image/png", headers=headers)
    if form is Format.NPZ:
        npz = await state.in_thread(functools.partial(desk.npz, name, max_age_s=max_age_s))
        disposition = {"Content-Disposition": f'attachment; filename="{name}.npz"'}
        return Response(npz, media_type="application/octet-stream", headers={**headers, **disposition})
    snapshot = await state.in_thread(functools.partial(desk.read, name, max_age_s=max_age_s))
    return JSONResponse(as_json(name, state.service.cell.file.devices[name].kind, snapshot), headers=headers)


@router.put(
    "/{name}",
    summary="Replace a device's driver or options while the cell runs",
    operation_id="swap_device",
    openapi_extra=body_schema(
        SwapRequest, {"driver": "serial:tfmini", "options": {"port": "/dev/serial/by-id/tfmini"}}, required=True
    ),
)
async def swap_device(
    state: State,
    name: Name,
    _holder: Admitted,
    request: Annotated[SwapRequest, DependsOn(strict_body(SwapRequest))],
) -> DeviceDetail:
    """Other devices are not affected. If the new driver does not connect, the old one is kept and the problem says so.

    A device that takes part in motions is not replaced while a motion runs. After the arm has been replaced, its drives
    are off until the next motion. The cell file is not changed and applies again after a restart of the service.
    """
    _check(state, name)
    await state.in_thread(functools.partial(_swap, state, name, request))
    return await state.in_thread(functools.partial(_detail, state.service, name))


@router.post(
    "/{name}/connect",
    summary="Connect a device again with its present driver and options",
    operation_id="connect_device",
)
async def connect_device(state: State, name: Name, _holder: Admitted) -> DeviceDetail:
    """For a device that did not connect at the cell's start, or whose driver has stopped. Refused as `PUT` is."""
    _check(state, name)
    await state.in_thread(functools.partial(_connect, state, name))
    return await state.in_thread(functools.partial(_detail, state.service, name))


@router.post(
    "/{name}/fault",
    summary="Inject a fault into a simulated device, or end it",
    operation_id="inject_fault",
    openapi_extra=body_schema(FaultRequest, {"fault": "silent", "magnitude": 0.0}),
)
async def inject_fault(
    state: State,
    name: Name,
    _holder: Admitted,
    request: Annotated[FaultRequest, DependsOn(strict_body(FaultRequest))],
) -> DeviceView:
    _check(state, name)
    return await state.act(functools.partial(_inject, state.service, name, request))


def _check(state: AppState, name: str) -> None:
    """Raise `NoSuchDevice` (404) unless the cell file has a device of that name."""
    try:
        check_name(state.service.cell, name)
    except InvalidRequest as error:
        raise NoSuchDevice(error.what, hint=error.hint) from None


def _swap(state: AppState, name: str, request: SwapRequest) -> None:
    section = state.service.cell.file.devices[name]
    if request.kind not in (None, section.kind) or request.mount not in (None, section.mount):
        raise InvalidRequest(
            f"{name} stays a {section.kind} with its mount", hint="send only driver and options", device=name
        )
    fresh = section.model_copy(update={"driver": request.driver, "options": request.options})
    state.service.swap_device(name, with_recordings(fresh, section, runs_dir=state.service.runs_dir))
    state.readings.forget(name)


def _connect(state: AppState, name: str) -> None:
    state.service.swap_device(name, state.service.cell.file.devices[name])
    state.readings.forget(name)


def _inject(service: Service, name: str, request: FaultRequest) -> DeviceView:
    device = service.supervisor.connection.device(name)
    if service.cell.file.cell.mode == "real" or not hasattr(device, "inject_fault"):
        raise Unsupported(
            f"{name} is not a simulated device, so faults cannot be injected", hint="use a simulated cell", device=name
        )
    device.inject_fault(request.fault, magnitude=request.magnitude)
    service.commit("fault-injected", {"device": name, "fault": request.fault, "magnitude": request.magnitude})
    return _view(service, name)


def _view(service: Service, name: str) -> DeviceView:
    section = service.cell.file.devices[name]
    return DeviceView(
        name=name,
        kind=section.kind,
        driver=section.driver,
        health=_health(service, name),
        reading_url=f"/v1/devices/{name}/reading",
    )


def _health(service: Service, name: str) -> HealthView:
    """Return the health of a device; one that does not answer counts as not connected, which is no error here."""
    try:
        return HealthView(**jsonable(service.supervisor.connection.device(name).health()))
    except CellError as error:
        return HealthView(connected=False, quality="invalid", cause="comm", detail=error.what)


def _detail(service: Service, name: str) -> DeviceDetail:
    section = service.cell.file.devices[name]
    capabilities: dict[str, Any] | None = None
    try:
        capabilities = jsonable(service.supervisor.connection.device(name).capabilities())
    except CellError:
        capabilities = None  # the health gives the reason
    return DeviceDetail(
        **_view(service, name).model_dump(),
        capabilities=capabilities,
        mount=section.mount.model_dump() if section.mount is not None else None,
        options={key: _shown(key, value) for key, value in section.options.items()},
    )


def _shown(key: str, value: Any) -> Any:
    return "***" if any(word in key.lower() for word in SECRET) else jsonable(value)
