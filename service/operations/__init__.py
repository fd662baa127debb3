"""The operations (verbs) of the cell, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from hal.config import Cell
from hal.devices import DeviceKind
from service.operations.session import OperationContext, Session, check_looked_for
from service.schema import fuse_request, fuse_results, mission_request, mission_results, requests, results

if TYPE_CHECKING:
    from manipulation import Kinematics
    from service.processes.connection import CellConnection
    from service.world_model import WorldModel

__all__ = ["OPERATIONS", "Operation", "OperationContext"]

Arm = Callable[[], "Kinematics | None"]
"""Gives the kinematics of the cell's arm; None while the cell is not running."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Operation:
    """An operation that the API offers as a verb.

    Attributes:
        name: path of the verb, e.g. `panel-pose`.
        request_model: strict model of the body.
        result_model: model of the result of a task of this verb.
        run: does the work in a worker thread; returns a `result_model` or raises `CellError`.
        summary: one line for the API document.
        example: a body that works on the shipped cell.
        moves: whether it may move the arm (needs the lease when one is held, and excludes other motion tasks).
        writes: whether it stores something that others see, even if nothing moves (needs the lease when one is held).
        needs: kinds of devices that it may need in addition to those of every motion (`moves`).
        is_still: returns whether a given request moves nothing although the verb may move the arm.
        can_pause: whether it has steps between which it can stand still.
        check: raises `InvalidRequest`, before a task is created, for a request that is not possible in this cell.
        check_with_arm: the same where it takes the arm to know that.
    """

    name: str
    request_model: type[BaseModel]
    result_model: type[BaseModel]
    run: Callable[[OperationContext, Any], BaseModel]
    summary: str
    example: dict[str, Any] = field(default_factory=dict)
    moves: bool = True
    writes: bool = False
    needs: tuple[DeviceKind, ...] = ()
    can_pause: bool = False
    is_still: Callable[[Any], bool] = field(default=lambda _request: False)
    check: Callable[[Cell, Any], None] = field(default=lambda _cell, _request: None)
    check_with_arm: Callable[[Cell, Any, Arm], None] = field(default=lambda _cell, _request, _arm: None)

    def refuse(self, cell: Cell, request: BaseModel, connection: CellConnection, world: WorldModel) -> None:
        """Raise `InvalidRequest` for a request that is not possible in this cell, before a task is created."""
        from service.feasibility import arm_of  # imported when needed, so that the service starts fast

        self.check(cell, request)
        self.check_with_arm(cell, request, lambda: arm_of(connection, world))

    def may_move(self, request: BaseModel) -> bool:
        """Return whether the arm may move for this request."""
        return self.moves and not self.is_still(request)


MEASUREMENT_EXAMPLE = {
    "sensing": "point-plane",
    "x_m": [0.0, 0.0, 0.0],
    "u": [0.0, 0.0, 1.0],
    "mu_m": [0.95, 0.02, 0.55],
    "c_m2": [[4e-8, 0.0, 0.0], [0.0, 4e-8, 0.0], [0.0, 0.0, 4e-8]],
    "label": "touch 1",
    "sensor": "finger_touch",
}


def _in_session(module: str, function: str) -> Callable[[OperationContext, Any], results.Result]:
    """Return a function that runs `service.operations.<module>.<function>(session, request)`.

    The module is imported at the first call, so that the service starts fast.
    """

    def run(context: OperationContext, request: Any) -> results.Result:
        from importlib import import_module

        verb = getattr(import_module(f"service.operations.{module}"), function)
        answer: results.Result = verb(Session(context=context), request)
        return answer

    return run


def _checked_by(function: str) -> Callable[[Cell, Any, Arm], None]:
    """Return a check by `service.feasibility.<function>(cell, request, arm)`, imported at the first call."""

    def check(cell: Cell, request: Any, arm: Arm) -> None:
        from service import feasibility

        getattr(feasibility, function)(cell, request, arm)

    return check


def _mission(context: OperationContext, request: mission_request.MissionRequest) -> mission_results.MissionResult:
    from service.operations.mission import run_mission

    return run_mission(context, request)


def _evaluate(context: OperationContext, request: requests.EvaluateRequest) -> mission_results.EvaluateResult:
    from service.evaluate import evaluate

    return evaluate(context.connection, context.runs_dir / request.mission)


def _is_stored(request: requests.StoredLook) -> bool:
    return request.image is not None


SENSORS = (DeviceKind.CAMERA, DeviceKind.LIGHTS, DeviceKind.RANGE_SCANNER)
OPERATIONS: dict[str, Operation] = {
    operation.name: operation
    for operation in (
        Operation(
            name="panel-pose",
            request_model=requests.PanelPoseRequest,
            result_model=results.PanelPoseResult,
            run=_in_session("locate", "run_panel_pose"),
            needs=(DeviceKind.CAMERA, DeviceKind.LIGHTS, DeviceKind.RANGE_SCANNER),
            summary="Locate the panel by lights, tags, outline or looks; the answer is its pose with covariance",
            example={"move": True},
        ),
        Operation(
            name="recognise",
            request_model=requests.RecogniseRequest,
            result_model=results.RecogniseResult,
            run=_in_session("recognise", "run_recognise"),
            needs=(DeviceKind.CAMERA, DeviceKind.RANGE_SCANNER),
            summary="Find the panel's objects in the camera's image or surfaces in the range image",
            example={"use": ["vision"], "mode": "taught"},
            check=check_looked_for,
            is_still=_is_stored,
        ),
        Operation(
            name="learn",
            request_model=requests.LearnRequest,
            result_model=results.LearnResult,
            run=_in_session("recognise", "run_learn"),
            needs=(DeviceKind.CAMERA,),
            writes=True,
            summary="Learn what the objects of the located panel look like, for blind recognition",
            example={"move": True},
            is_still=_is_stored,
        ),
        Operation(
            name="inspect",
            request_model=requests.InspectRequest,
            result_model=results.InspectResult,
            run=_in_session("inspect", "run_inspect"),
            needs=(DeviceKind.CAMERA,),
            summary="Read instruments, lamps, switches and valves from close up",
            example={"objects": ["pressure", "main_valve"], "least_confidence": 0.5},
            check=check_looked_for,
            is_still=_is_stored,
        ),
        Operation(
            name="fuse",
            request_model=fuse_request.FuseRequest,
            result_model=fuse_results.FuseResult,
            run=_in_session("sense", "run_fuse"),
            needs=SENSORS,
            summary="Fuse measurements of nine kinds into one pose, or collect them first",
            example={"measurements": [MEASUREMENT_EXAMPLE]},
        ),
        Operation(
            name="manipulate",
            request_model=requests.ManipulateRequest,
            result_model=mission_results.ManipulateResult,
            run=_in_session("manipulate", "run_manipulate"),
            needs=(DeviceKind.CAMERA,),
            summary="Operate one control and read back whether it reached its target",
            example={"object": "main_valve", "state": "open"},
            check_with_arm=_checked_by("check_manipulate"),
        ),
        Operation(
            name="missions",
            request_model=mission_request.MissionRequest,
            result_model=mission_results.MissionResult,
            run=_mission,
            needs=SENSORS,
            summary="Run a mission and write its report; without a mission, inspect and touch nothing",
            example={"file": "demo"},
            can_pause=True,
            is_still=lambda request: request.dry_run,
            check_with_arm=_checked_by("check_mission"),
        ),
        Operation(
            name="calibrations",
            request_model=requests.CalibrationRequest,
            result_model=results.CalibrationResult,
            run=_in_session("calibrate", "run_calibrations"),
            needs=SENSORS,
            summary="Calibrate camera, hand-eye, range scanner or tool; the arm drives through poses, and the record is stored",
            example={"what": "hand-eye", "poses": 12},
            is_still=lambda request: request.dry_run,
        ),
        Operation(
            name="judge",
            request_model=requests.EvaluateRequest,
            result_model=mission_results.EvaluateResult,
            run=_evaluate,
            summary="Compare a finished mission with the simulator's truth (simulated cells only)",
            example={"mission": "20261120T231502-a1b2c3"},
            moves=False,
            writes=True,
        ),
    )
}
