"""Operations for tests: they do what their request says, on the cell of fakes."""

from __future__ import annotations

import threading
from typing import Annotated

from pydantic import BaseModel, Field

from hal.clock import Deadline
from hal.config import Cell
from hal.errors import DeviceTimeout, InvalidRequest
from hal.motion import Hold
from hal.strict import Strict
from service.operations import Operation, OperationContext


class EchoRequest(Strict):
    """Gives back what it got."""

    text: Annotated[str, Field(max_length=100)] = "hello"
    number: Annotated[float, Field(ge=-1e6, le=1e6)] = 1.0
    point_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class HoldRequest(Strict):
    """Stands still for a while, in small motions."""

    seconds: Annotated[float, Field(gt=0, le=1e6)] = 1e6


class FailRequest(Strict):
    """Fails."""

    defect: bool = False


class EchoResult(BaseModel):
    """What was said."""

    text: str
    number: float
    nothing: float | None


class HoldResult(BaseModel):
    """How long it stood still."""

    held_s: float


class MeasureResult(BaseModel):
    """What the sensor says."""

    distance_m: float


def echo(context: OperationContext, request: EchoRequest) -> EchoResult:
    context.task.progress(0.25, "listening")
    context.task.progress(0.75, "speaking", request.text)
    context.task.artefact("said.txt", request.text.encode(), "text/plain")
    return EchoResult(text=request.text, number=request.number, nothing=float("nan"))


def refuse_shouting(_cell: Cell, request: EchoRequest) -> None:
    if request.text.isupper():
        raise InvalidRequest("no shouting", hint="lower the voice")


def hold(context: OperationContext, request: HoldRequest) -> HoldResult:
    """Moves until it is cancelled."""
    mover = context.connection.mover
    done_s = 0.0
    while done_s < request.seconds:
        context.task.pause_point(lambda: mover.execute(Hold(name="pause", duration_s=0.1)))
        context.task.progress(min(0.99, done_s / request.seconds), "holding")
        report = mover.execute(Hold(name="hold", duration_s=0.2))
        done_s += report.duration_s
        if report.outcome == "stopped":
            raise DeviceTimeout("the arm was stopped", hint="reset", device="arm")
        threading.Event().wait(0.001)
    return HoldResult(held_s=done_s)


def wait(context: OperationContext, request: HoldRequest) -> HoldResult:
    """Waits without an arm until it is cancelled."""
    while True:
        context.task.check_cancelled()
        threading.Event().wait(0.001)


def fail(context: OperationContext, request: FailRequest) -> HoldResult:
    if request.defect:
        raise ZeroDivisionError("planted")
    raise DeviceTimeout("wrist_ft silent for 0.50 s", hint="check power and cable", device="wrist_ft")


def measure(context: OperationContext, request: EchoRequest) -> MeasureResult:
    device = context.connection.device("finger_proximity")
    deadline = Deadline.after(context.connection.clock, 1.0)
    return MeasureResult(distance_m=device.read_distance_m(deadline=deadline).value)


OPERATIONS = {
    operation.name: operation
    for operation in (
        Operation(
            name="echo",
            request_model=EchoRequest,
            result_model=EchoResult,
            run=echo,
            summary="Echo",
            example={"text": "a"},
            moves=False,
            check=refuse_shouting,
        ),
        Operation(
            name="hold",
            request_model=HoldRequest,
            result_model=HoldResult,
            run=hold,
            summary="Hold",
            example={"seconds": 0.1},
            can_pause=True,
        ),
        Operation(
            name="wait",
            request_model=HoldRequest,
            result_model=HoldResult,
            run=wait,
            summary="Wait",
            example={"seconds": 0.1},
        ),
        Operation(
            name="note",
            request_model=EchoRequest,
            result_model=EchoResult,
            run=echo,
            summary="Note",
            moves=False,
            writes=True,
        ),
        Operation(
            name="fail",
            request_model=FailRequest,
            result_model=HoldResult,
            run=fail,
            summary="Fail",
            example={"defect": False},
            moves=False,
        ),
        Operation(
            name="measure",
            request_model=EchoRequest,
            result_model=MeasureResult,
            run=measure,
            summary="Measure",
            moves=False,
        ),
    )
}
