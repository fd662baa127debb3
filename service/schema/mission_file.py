"""The model of a mission file: named steps, with the conditions that each needs and what to do when one fails."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from hal.fault_words import ONE_LINE
from hal.panel.turn import meant_otherwise
from hal.strict import Strict
from service.schema.requests import ActionBody, ObjectName, Touches, WantedPose

StepName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
MissionName = Annotated[
    str, Field(pattern=r"^[a-z][a-z0-9_-]{0,60}$", description="name of a mission file without its ending")
]
MOST_STEPS = 200
FEWEST_TRIES = 2


class Condition(Strict):
    """What an object must show, by a look that is taken for this question.

    A value counts as below or above only if its whole 95 % interval is; otherwise the answer is unknown.
    """

    object: ObjectName
    below: Annotated[float | None, Field(description="the value must be less than this")] = None
    above: Annotated[float | None, Field(description="the value must be more than this")] = None
    unit: Annotated[
        str | None, Field(max_length=40, description="unit of the numbers; the object's, where it has one")
    ] = None
    state: Annotated[str | None, Field(max_length=41, description="the state that it must show")] = None

    @model_validator(mode="after")
    def _asks_something(self) -> Condition:
        has_number = self.below is not None or self.above is not None
        if has_number == (self.state is not None):
            raise meant_otherwise("a condition asks for a number or for a state", "give below, above or both, or state")
        if self.below is not None and self.above is not None and self.above >= self.below:
            what = f"no value is above {self.above:g} and below {self.below:g}"
            raise meant_otherwise(what, "swap them, or leave one out")
        if self.state is not None and self.unit is not None:
            raise meant_otherwise("a state has no unit", "leave unit out")
        return self


Conditions = Annotated[tuple[Condition, ...], Field(max_length=20)]
GivenConditions = Annotated[tuple[Condition, ...], Field(min_length=1, max_length=20)]


class StepBase(Strict):
    """What every step has."""

    kind: str
    name: StepName
    needs: Annotated[
        Conditions, Field(description="conditions that are looked at first; one that is unmet or unknown ends the step")
    ] = ()
    on_failure: Annotated[
        Literal["stop", "skip", "retry"],
        Field(description="stop: end the mission and park; skip: go on with the next step; retry: again, then stop"),
    ] = "stop"
    tries: Annotated[int, Field(ge=FEWEST_TRIES, le=10, description="tries in all, with on_failure = retry")] = (
        FEWEST_TRIES
    )

    @model_validator(mode="after")
    def _tries_again(self) -> Self:
        if self.tries != FEWEST_TRIES and self.on_failure != "retry":
            raise meant_otherwise("tries is of use only with on_failure = 'retry'", "add that, or leave tries out")
        return self


class InspectStep(StepBase):
    """Read objects from close up."""

    kind: Literal["inspect"] = "inspect"
    objects: Annotated[
        tuple[ObjectName, ...] | None, Field(min_length=1, max_length=200, description="all objects if left out")
    ] = None


class FeelStep(StepBase):
    """Touch the plate and fuse all senses into the panel's pose."""

    kind: Literal["feel"] = "feel"
    touches: Touches = 4
    wanted: WantedPose = WantedPose()


class SetStep(StepBase):
    """Operate one control and read it back; or one control of each kind."""

    kind: Literal["set"] = "set"
    object: ObjectName | None = None
    state: Annotated[str, Field(max_length=41)] | None = None
    value: float | None = None
    angle_rad: Annotated[float, Field(ge=-100.0, le=100.0)] | None = None
    other: Annotated[bool, Field(description="to another state or value than it shows")] = False
    each_kind: Annotated[
        bool, Field(description="one control of each kind that the panel has, to another state or value than it shows")
    ] = False
    confirm: Annotated[
        ObjectName | None, Field(description="the object's name again, for a control that asks for it")
    ] = None

    @model_validator(mode="after")
    def _has_one_target(self) -> SetStep:
        targets = [key for key in ("state", "value", "angle_rad") if getattr(self, key) is not None]
        targets += ["other"] if self.other else []
        if self.each_kind == (self.object is not None):
            raise meant_otherwise("a step sets one object, or one of each kind", "give object, or each_kind = true")
        if self.each_kind and self.confirm is not None:
            raise meant_otherwise("confirm names one object, and each_kind sets one of each kind", "leave confirm out")
        if len(targets) > 1 or (self.each_kind and targets):
            given = ", ".join(targets)
            raise meant_otherwise(f"{given} cannot be given together here", "keep one; none with each_kind")
        return self

    def action(self) -> ActionBody:
        """Return the action on the step's object; one without a target for `other`."""
        keys = ("object", "state", "value", "angle_rad", "confirm")
        return ActionBody.model_validate({key: getattr(self, key) for key in keys if getattr(self, key) is not None})


class RequireStep(StepBase):
    """Go on only if all conditions are met."""

    kind: Literal["require"] = "require"
    conditions: GivenConditions


class WaitStep(StepBase):
    """Look again and again until all conditions are met."""

    kind: Literal["wait_until"] = "wait_until"
    conditions: GivenConditions
    timeout_s: Annotated[float, Field(gt=0.0, le=86_400.0, description="on the cell's clock")]
    every_s: Annotated[float, Field(ge=1.0, le=3600.0, description="between two looks")] = 10.0


class ChooseStep(StepBase):
    """Run `then` if all conditions are met, and `otherwise` if one is unmet; an unknown one fails the step."""

    kind: Literal["choose"] = "choose"
    when: GivenConditions
    then: Annotated[tuple[Step, ...], Field(min_length=1, max_length=MOST_STEPS)]
    otherwise: Annotated[tuple[Step, ...], Field(max_length=MOST_STEPS)] = ()


class RepeatStep(StepBase):
    """Run the steps several times, at most until the conditions are met after a round."""

    kind: Literal["repeat"] = "repeat"
    times: Annotated[int, Field(ge=1, le=1000)]
    until: Conditions = ()
    steps: Annotated[tuple[Step, ...], Field(min_length=1, max_length=MOST_STEPS)]


class CallStep(StepBase):
    """Run the steps of another mission file."""

    kind: Literal["call"] = "call"
    mission: MissionName


Step = Annotated[
    InspectStep | FeelStep | SetStep | RequireStep | WaitStep | ChooseStep | RepeatStep | CallStep,
    Field(discriminator="kind"),
]


class MissionLimits(Strict):
    """`[limits]` of a mission file: limits of its motions besides those of the cell, of which the stricter holds."""

    speed_m_per_s: Annotated[float | None, Field(ge=0.02, le=2.0, description="largest speed of the tool's tip")] = None
    force_n: Annotated[float | None, Field(gt=0.0, le=500.0, description="contact force that ends any motion")] = None


class MissionFile(Strict):
    """A mission: its steps run one after the other, after the panel has been located and its objects found."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    title: Annotated[str, Field(max_length=200, pattern=ONE_LINE)] = ""
    limits: MissionLimits = MissionLimits()
    steps: Annotated[tuple[Step, ...], Field(min_length=1, max_length=MOST_STEPS)]

    @model_validator(mode="after")
    def _names_are_different(self) -> MissionFile:
        repeated = _repeated(_names(self.steps))
        if repeated:
            raise meant_otherwise(*repeated)
        return self

    @classmethod
    def further_faults(cls, data: dict[str, Any]) -> list[Any]:
        """Return names that stand at several steps, which are not looked for if a step is malformed."""
        repeated = _repeated(_plain_names(data.get("steps")))
        if not repeated:
            return []
        text, hint = repeated
        return [{"type": "names", "loc": (), "msg": text, "input": None, "ctx": {"hint": hint}}]


def conditions_of(step: Step) -> tuple[Condition, ...]:
    """Return the conditions that a step itself looks at."""
    match step:
        case RequireStep() | WaitStep():
            return (*step.needs, *step.conditions)
        case ChooseStep():
            return (*step.needs, *step.when)
        case RepeatStep():
            return (*step.needs, *step.until)
    return step.needs


def _repeated(names: list[str]) -> tuple[str, str] | None:
    """Return what is wrong with names that are not all different, and what to do."""
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    return (f"several steps are called {', '.join(repeated)}", "give each step its own name") if repeated else None


def _plain_names(steps: Any) -> list[str]:
    """Return the names of steps in plain data, of which anything may be malformed."""
    found: list[str] = []
    for step in steps if isinstance(steps, list) else ():
        if isinstance(step, dict):
            found += [step["name"]] if isinstance(step.get("name"), str) else []
            found += [name for key in ("then", "otherwise", "steps") for name in _plain_names(step.get(key))]
    return found


def _names(steps: tuple[Step, ...]) -> list[str]:
    """Return the names of steps and of the steps within them."""
    found: list[str] = []
    for step in steps:
        found.append(step.name)
        if isinstance(step, ChooseStep):
            found += _names(step.then) + _names(step.otherwise)
        elif isinstance(step, RepeatStep):
            found += _names(step.steps)
    return found


for model in (ChooseStep, RepeatStep, MissionFile):
    model.model_rebuild()
