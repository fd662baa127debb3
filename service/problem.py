"""Converts errors to RFC 9457 problems, as plain values for HTTP answers, tasks and the journal."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any, NotRequired, TypedDict

from hal import errors as hal_errors
from hal.errors import CellError
from service import errors
from service.jsonable import jsonable

STATUS: dict[type[CellError], HTTPStatus] = {
    # The first base class found here determines the status.
    CellError: HTTPStatus.INTERNAL_SERVER_ERROR,
    hal_errors.ConfigError: HTTPStatus.UNPROCESSABLE_ENTITY,
    hal_errors.InvalidRequest: HTTPStatus.UNPROCESSABLE_ENTITY,
    hal_errors.Unsupported: HTTPStatus.CONFLICT,
    hal_errors.DeviceError: HTTPStatus.SERVICE_UNAVAILABLE,
    hal_errors.DeviceTimeout: HTTPStatus.GATEWAY_TIMEOUT,
    hal_errors.DeviceFault: HTTPStatus.BAD_GATEWAY,
    hal_errors.MotionError: HTTPStatus.CONFLICT,
    hal_errors.Cancelled: HTTPStatus.CONFLICT,
    hal_errors.LeaseError: HTTPStatus.CONFLICT,
    hal_errors.PerceptionError: HTTPStatus.CONFLICT,
    errors.NoSuchTask: HTTPStatus.NOT_FOUND,
    errors.NotPossibleNow: HTTPStatus.CONFLICT,
    errors.Busy: HTTPStatus.SERVICE_UNAVAILABLE,
    errors.JournalError: HTTPStatus.SERVICE_UNAVAILABLE,
    errors.StepFailed: HTTPStatus.CONFLICT,
    errors.HistoryError: HTTPStatus.SERVICE_UNAVAILABLE,
    errors.Unauthenticated: HTTPStatus.UNAUTHORIZED,
    errors.Forbidden: HTTPStatus.FORBIDDEN,
    errors.KeysUnusable: HTTPStatus.SERVICE_UNAVAILABLE,
    errors.FileFault: HTTPStatus.SERVICE_UNAVAILABLE,
    errors.Aborted: HTTPStatus.CONFLICT,
}


class ProblemFields(TypedDict):
    """A problem as tasks and reports keep it; reports of defects have no `type`, `status` and `details`."""

    type: NotRequired[str]
    title: str
    status: NotRequired[int]
    detail: str
    hint: str
    retry: str
    details: NotRequired[dict[str, Any]]


def status_of(error: CellError) -> int:
    """Return the HTTP status for an error."""
    return int(next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS))


def problem_of(error: CellError) -> ProblemFields:
    """Return `type`, `title`, `status`, `detail`, `hint`, `retry` and `details` of an error as plain JSON values."""
    return {
        "type": f"urn:panelwright:{error.type_name}",
        "title": error.type_name.replace("-", " ").capitalize(),
        "status": status_of(error),
        "detail": error.what,
        "hint": error.hint,
        "retry": str(error.retry),
        "details": jsonable(error.details),
    }
