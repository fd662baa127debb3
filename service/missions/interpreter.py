"""Runs the steps of a mission with whatever has hands and eyes; knows no cell.

No step touches anything before its conditions were looked at and are met: an unmet or unknown one ends the step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

from hal.errors import CellError, InvalidRequest, PerceptionError, Unreachable
from service.errors import StepFailed
from service.missions.conditions import Answer, Seen, judge
from service.missions.progress import Progress
from service.schema.mission_file import (
    CallStep,
    ChooseStep,
    Condition,
    FeelStep,
    InspectStep,
    RepeatStep,
    RequireStep,
    SetStep,
    Step,
    WaitStep,
)

ENDS_A_STEP = (StepFailed, InvalidRequest, PerceptionError, Unreachable)
"""Errors after which the mission can go on; every other one, such as a device that failed, ends it."""
ALWAYS_AGAIN = (RequireStep,)
"""Steps that guard what follows, and so are looked at again when a mission is taken up."""


class Hands(Protocol):
    """What a mission can do; every method raises a `CellError` when it fails."""

    def inspect(self, step: InspectStep) -> None:
        """Read objects and report the readings."""
        ...

    def look(self, names: Collection[str]) -> Mapping[str, Seen]:
        """Return what the objects show now, by a look that is taken now."""
        ...

    def feel(self, step: FeelStep) -> None:
        """Touch the panel and fuse its pose."""
        ...

    def set(self, step: SetStep) -> str:
        """Operate the control (or one of each kind); returns why it did not succeed, empty if it did."""
        ...

    def wait(self, duration_s: float) -> None:
        """Let time of the cell's clock pass, standing still."""
        ...

    def now_s(self) -> float:
        """Return the time of the cell's clock."""
        ...

    def begins(self, path: str, kind: str) -> None:
        """Take note that a step begins; raises `Cancelled` if the mission was cancelled."""
        ...


def leaves_of(progress: Progress) -> int:
    """Return how many steps of a mission do something themselves."""
    return sum(not isinstance(step, ChooseStep | RepeatStep | CallStep) for step in progress.all_steps())


@dataclass(frozen=True, slots=True, kw_only=True)
class StepOutcome:
    """How a step ended: `done`, `taken over` from the mission before, `skipped` or `failed`."""

    path: str
    kind: str
    outcome: Literal["done", "taken over", "skipped", "failed"]
    detail: str = ""


@dataclass(slots=True, kw_only=True, eq=False)
class Interpreter:
    """One run of a mission.

    Attributes:
        outcomes: of the steps so far, in the order in which they ended.
    """

    hands: Hands
    progress: Progress
    outcomes: list[StepOutcome] = field(default_factory=list)

    def run(self) -> None:
        """Run all steps that are not done yet.

        Raises:
            CellError: a step failed whose `on_failure` is not `skip`, or the cell cannot go on.
        """
        self._all(self.progress.mission.steps, "")

    def _all(self, steps: Sequence[Step], above: str) -> None:
        for step in steps:
            self._one(step, f"{above}{step.name}")

    def _one(self, step: Step, path: str) -> None:
        if self.progress.is_done(path) and not isinstance(step, ALWAYS_AGAIN):
            self._note(step, path, "taken over")
            return
        tries = step.tries if step.on_failure == "retry" else 1
        for left in reversed(range(tries)):
            try:
                self.hands.begins(path, step.kind)
                self._need(step.needs, path)
                self._do(step, path)
            except ENDS_A_STEP as error:
                if left:
                    continue
                if step.on_failure != "skip":
                    self._note(step, path, "failed", error.what)
                    raise
                self._note(step, path, "skipped", error.what)
                return
            except CellError as error:
                self._note(step, path, "failed", error.what)
                raise
            else:
                break
        self.progress.note_done(path)
        self._note(step, path, "done")

    def _do(self, step: Step, path: str) -> None:
        match step:
            case InspectStep():
                self.hands.inspect(step)
            case FeelStep():
                self.hands.feel(step)
            case SetStep():
                if why := self.hands.set(step):
                    raise StepFailed(f"step {path}: {why}", hint="see the report; or write on_failure", step=path)
            case RequireStep():
                self._need(step.conditions, path)
            case WaitStep():
                self._wait(step, path)
            case ChooseStep():
                self._choose(step, path)
            case RepeatStep():
                self._repeat(step, path)
            case CallStep():
                self._all(self.progress.library[step.mission].steps, f"{path}/")

    def _need(self, conditions: Sequence[Condition], path: str) -> None:
        """Look at the objects of the conditions, and raise unless all are met."""
        found = self._judged(conditions)
        if found[0] is not Answer.MET:
            what = f"step {path} was ended before it did anything: {found[1]}"
            hint = "bring the panel into the state that the step needs, then take the mission up again"
            raise StepFailed(what, hint=hint, step=path, answer=str(found[0]))

    def _judged(self, conditions: Sequence[Condition]) -> tuple[Answer, str]:
        if not conditions:
            return Answer.MET, ""
        found = judge(conditions, self.hands.look(list(dict.fromkeys(one.object for one in conditions))))
        return found.answer, found.says

    def _wait(self, step: WaitStep, path: str) -> None:
        end_s = self.hands.now_s() + step.timeout_s
        while True:
            answer, says = self._judged(step.conditions)
            if answer is Answer.MET:
                return
            left_s = end_s - self.hands.now_s()
            if left_s <= 0.0:
                what = f"step {path} has waited {step.timeout_s:g} s: {says}"
                raise StepFailed(what, hint="see why the panel does not get there; or wait longer", step=path)
            self.hands.wait(min(step.every_s, left_s))

    def _choose(self, step: ChooseStep, path: str) -> None:
        branch = self.progress.branches.get(path)
        if branch is None:
            answer, says = self._judged(step.when)
            if answer is Answer.UNKNOWN:
                raise StepFailed(f"step {path} cannot choose: {says}", hint="see why it cannot be read", step=path)
            branch = "then" if answer is Answer.MET else "otherwise"
            self.progress.note_branch(path, branch)
        self._all(step.then if branch == "then" else step.otherwise, f"{path}/")

    def _repeat(self, step: RepeatStep, path: str) -> None:
        for k in range(1, step.times + 1):
            self._all(step.steps, f"{path}#{k}/")
            if not step.until:
                continue
            answer, says = self._judged(step.until)
            if answer is Answer.MET:
                return
            if answer is Answer.UNKNOWN:
                raise StepFailed(f"step {path} cannot decide: {says}", hint="see why it cannot be read", step=path)
        if step.until:
            what = f"step {path} has run {step.times} times: {says}"
            raise StepFailed(what, hint="see why the panel does not get there; or repeat more often", step=path)

    def _note(
        self, step: Step, path: str, outcome: Literal["done", "taken over", "skipped", "failed"], detail: str = ""
    ) -> None:
        self.outcomes.append(StepOutcome(path=path, kind=step.kind, outcome=outcome, detail=detail))
