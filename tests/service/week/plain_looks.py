"""Missions for tests of the week: real steps, conditions and records, but what an instrument shows is taken from the simulator.

A real look renders a camera's picture and reads it, which takes most of the time of a simulated week. That these looks are right
has tests of its own, and the tutorial runs a day with them.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from hal.devices import DeviceKind
from perception.vision import ObjectReading
from service.missions.conditions import Seen
from service.missions.files import mission_of
from service.missions.interpreter import Interpreter, StepOutcome
from service.missions.progress import Progress
from service.operations import Operation, OperationContext
from service.schema.mission_file import FeelStep, InspectStep, SetStep
from service.schema.mission_request import MissionRequest
from service.schema.requests import ManipulateRequest

PNG = b"\x89PNG of an instrument"
SIGMA = 0.02


class MissionTold(BaseModel):
    """What the rounds of the week ask of a mission's result."""

    mission: str = ""
    steps: list[dict[str, Any]] = []


class PlainHands:
    """Does the steps of a mission on the simulator's truth; see `service.missions.interpreter.Hands`.

    Args:
        worked: what controls were set to, for all missions of a test.
    """

    def __init__(self, context: OperationContext, name: str, worked: dict[str, str]) -> None:
        self._context, self._name, self._worked = context, name, worked

    def inspect(self, step: InspectStep) -> None:
        self._keep([self._seen(name) for name in step.objects or ()])

    def look(self, names: Collection[str]) -> Mapping[str, Seen]:
        return {name: Seen.of(self._seen(name)) for name in names}

    def set(self, step: SetStep) -> str:
        name, state = str(step.object), str(step.state)
        self._worked[name] = state
        self._context.observer.told(name, state)
        self._keep([self._seen(name)])
        return ""

    def feel(self, step: FeelStep) -> None:
        raise AssertionError(f"no mission of the week touches the panel, but {step.name} does")

    def wait(self, duration_s: float) -> None:
        raise AssertionError(f"no mission of the week waits, but one does for {duration_s} s")

    def now_s(self) -> float:
        return self._context.connection.clock.now_s()

    def begins(self, path: str, kind: str) -> None:
        self._context.task.progress(0.5, "step", f"{path} {kind}")

    def _keep(self, readings: list[ObjectReading]) -> None:
        self._context.observer.saw(readings, {one.name: PNG for one in readings}, mission=self._name)

    def _seen(self, name: str) -> ObjectReading:
        (arm,) = self._context.connection.devices_of(DeviceKind.ARM).values()
        (truth,) = [one for one in arm.truth().objects if one.name == name]
        spec = self._context.connection.cell.panel.object(name)
        given: dict[str, Any] = {"confidence": 0.95, "value": truth.value, "state": truth.state, "text": truth.text}
        if spec.states_shown:
            given |= {"value": None, "state": self._worked.get(name, truth.state)}
        elif truth.value is not None:
            low = spec.scale.minimum if hasattr(spec, "scale") else spec.minimum
            given |= {"uncertainty": SIGMA}
            given |= {"reason": "the needle stands off its scale"} if truth.value < low else {}
        nothing = np.zeros((0, 2))
        return ObjectReading(
            name=name, kind=spec.kind, present=True, centre_px=np.zeros(2), outline_px=nothing, **given
        )


def operations() -> dict[str, Operation]:
    """Return the verbs that a week uses."""
    worked: dict[str, str] = {}

    def run_mission(context: OperationContext, request: MissionRequest) -> MissionTold:
        checked = mission_of(request, context.connection.cell)
        name = time.strftime("%Y%m%dT%H%M%S", time.gmtime(context.observer.now_s())) + f"-{context.task.id}"
        hands = PlainHands(context, name, worked)
        interpreter = Interpreter(
            hands=hands, progress=Progress(mission=checked.mission, library=checked.library, path=None)
        )
        interpreter.run()
        (context.runs_dir / name).mkdir(parents=True)
        (context.runs_dir / name / "report.html").write_text("<h1>report</h1>")
        return MissionTold(mission=name, steps=[_told(one) for one in interpreter.outcomes])

    def manipulate(context: OperationContext, request: ManipulateRequest) -> MissionTold:
        del context
        worked[request.object] = str(request.state)
        return MissionTold()

    verbs = (("missions", MissionRequest, run_mission), ("manipulate", ManipulateRequest, manipulate))
    return {
        name: Operation(
            name=name, request_model=asked, result_model=MissionTold, run=run, summary="Of a test", moves=True
        )
        for name, asked, run in verbs
    }


def _told(outcome: StepOutcome) -> dict[str, Any]:
    return {"path": outcome.path, "outcome": outcome.outcome}
