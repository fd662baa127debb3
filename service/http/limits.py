"""`/v1/limits`: limits of objects that people set while the service runs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path
from pydantic import BaseModel, Field
from starlette.responses import Response

from hal.panel.limits import Limits
from service.http.body import body_schema, strict_body
from service.http.problems import RESPONSES
from service.http.state import State

router = APIRouter(prefix="/v1/limits", tags=["alarms"], responses=RESPONSES)
ObjectName = Annotated[str, Path(alias="object", pattern=r"^[a-z][a-z0-9_]{0,40}$", examples=["pressure"])]
EXAMPLE = {"low": 1.0, "high": 6.0, "deadband": 0.2}
BODIES = (Limits,)


class LimitsView(BaseModel):
    """Limits that were set for one object, and who set them when; `by` is null without keys."""

    object: str
    limits: Limits
    set_s: Annotated[float, Field(description="seconds since 1970")]
    by: str | None


class LimitsList(BaseModel):
    """The limits that were set in place of those of the panel file."""

    limits: list[LimitsView]


@router.get("", summary="Limits that were set in place of those of the panel file", operation_id="list_limits")
async def list_limits(state: State) -> LimitsList:
    found = state.service.plant.limits.all()
    views = [LimitsView(object=name, limits=one.limits, set_s=one.set_s, by=one.by) for name, one in found.items()]
    return LimitsList(limits=views)


@router.put(
    "/{object}",
    summary="Set the limits of an object, in place of those of the panel file",
    operation_id="set_limits",
    status_code=204,
    openapi_extra=body_schema(Limits, EXAMPLE, required=True),
)
async def set_limits(
    state: State, name: ObjectName, limits: Annotated[Limits, Depends(strict_body(Limits))]
) -> Response:
    await state.act(lambda: state.service.plant.set_limits(name, limits))
    return Response(status_code=204)


@router.delete(
    "/{object}",
    summary="Let the limits of the panel file hold again",
    operation_id="reset_limits",
    status_code=204,
)
async def reset_limits(state: State, name: ObjectName) -> Response:
    await state.act(lambda: state.service.plant.set_limits(name, None))
    return Response(status_code=204)
