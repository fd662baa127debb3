"""`POST /v1/read`: reads one instrument in a stored photograph, or in several; nothing moves."""

from __future__ import annotations

import functools
from typing import Annotated

from fastapi import APIRouter
from fastapi import Depends as DependsOn

from service.http.body import body_schema, strict_body
from service.http.images import store_of
from service.http.problems import RESPONSES
from service.http.state import State
from service.knowledge.photographs import read_stored_photograph
from service.schema.requests import ReadPhotographRequest
from service.schema.results import PhotographReading

router = APIRouter(prefix="/v1", tags=["images"], responses=RESPONSES)
EXAMPLE = {"image": "3f9c2a7be01d4c553f9c2a7b", "kind": "gauge", "scale": [0.0, 10.0], "unit": "bar"}


@router.post("/read-photograph", include_in_schema=False)  # the path until 0.9
@router.post(
    "/read",
    summary="Read one instrument in a stored photograph",
    operation_id="read_photograph",
    openapi_extra=body_schema(ReadPhotographRequest, EXAMPLE, required=True),
)
async def read_photograph(
    state: State, request: Annotated[ReadPhotographRequest, DependsOn(strict_body(ReadPhotographRequest))]
) -> PhotographReading:
    return await state.in_thread(functools.partial(read_stored_photograph, store_of(state), request))
