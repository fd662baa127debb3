"""Parses bodies strictly with pydantic's JSON reader, so that NaN, 1e400, unknown keys and invalid text are 4xx."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from hal.strict import unknown_key_hint
from service.http.problems import BadBody, FieldFault, path_of, refuse_body

B = TypeVar("B", bound=BaseModel)
MAX_FAULTS = 20
UNKNOWN_KEY = "extra_forbidden"


def strict_body(model: type[B]) -> Callable[[Request], Awaitable[B]]:
    """Return a dependency that reads the request's JSON body as `model`; an empty body counts as `{}`."""

    async def read(request: Request) -> B:
        data = await request.body()
        if data and request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            # Browsers send other types across origins without a preflight request.
            raise refuse_body(415, "the body's type is not application/json", hint="Content-Type: application/json")
        return parse(data or b"{}", model)

    return read


def parse(data: bytes, model: type[B]) -> B:
    """Parse `data` as `model`.

    Raises:
        BadBody: names what is wrong and where, without repeating the input.
    """
    try:
        body = model.model_validate_json(data, strict=True)
    except ValidationError as error:
        raise _refused(error, model) from None
    json.loads(data, object_pairs_hook=_without_repeats)  # pydantic takes the last of equal keys without a word
    if not _is_finite(body.model_dump()):
        raise refuse_body(422, "a number is not finite", hint="send finite numbers")
    return body


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    counts = Counter(key for key, _ in pairs)
    repeated = sorted(key for key, count in counts.items() if count > 1)
    if repeated:
        names = ", ".join(repr(key[:40]) for key in repeated[:MAX_FAULTS])
        raise refuse_body(422, f"an object has the key {names} more than once", hint="send each key once")
    return dict(pairs)


def _refused(error: ValidationError, model: type[BaseModel]) -> BadBody:
    found = error.errors(include_input=False, include_url=False, include_context=False)
    # A misspelt key is reported first, because it also makes the right key missing.
    items = sorted(found, key=lambda item: item["type"] != UNKNOWN_KEY)[:MAX_FAULTS]
    faults = [FieldFault(path=path_of(("body", *item["loc"])), message=_words(item)) for item in items]
    status = 400 if items[0]["type"] == "json_invalid" else 422
    first, hint = faults[0], "see /openapi.json for the body"
    if items[0]["type"] == UNKNOWN_KEY:
        hint = unknown_key_hint(model, items[0]["loc"])
    return refuse_body(status, f"{first.path}: {first.message}", hint=hint, faults=faults)


def _words(item: ErrorDetails) -> str:
    if item["type"] == UNKNOWN_KEY:
        return "unknown key"
    return item["msg"].removeprefix("Value error, ").encode("utf-8", "replace").decode()[:300]


def _is_finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(_is_finite(item) for item in value.values())
    if isinstance(value, list | tuple):
        return all(_is_finite(item) for item in value)
    return True


def body_schema(
    model: type[BaseModel], example: dict[str, Any] | None = None, *, required: bool = False
) -> dict[str, Any]:
    """Return the `openapi_extra` of a route with `strict_body(model)`; `app.openapi` adds the schema."""
    media: dict[str, Any] = {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}
    if example is not None:
        media["example"] = example
    return {"requestBody": {"required": required, "content": {"application/json": media}}}
