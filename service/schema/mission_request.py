"""The body of `POST /v1/missions`: a mission file's name, a mission, or a few actions in short."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from hal.strict import Strict
from service.schema.mission_file import FeelStep, InspectStep, MissionFile, MissionName, SetStep, Step
from service.schema.requests import ActionBody, Touches, WantedPose

MissionId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,80}$")]
USUAL_TOUCHES = 4


class MissionRequest(Strict):
    """Run a mission: `file`, `mission`, `resume`, or `actions` and `touches`. Without any it inspects and touches nothing."""

    file: Annotated[MissionName | None, Field(examples=["demo"])] = None
    mission: Annotated[MissionFile | None, Field(description="a mission as in a mission file")] = None
    resume: Annotated[
        MissionId | None,
        Field(description="name of an earlier mission, which is taken up at its first unfinished step"),
    ] = None
    actions: Annotated[
        tuple[ActionBody, ...] | None,
        Field(max_length=50, description="in short: inspect, touch, then these, of which a failed one is skipped"),
    ] = None
    touches: Annotated[Touches | None, Field(description="4 with actions, none without")] = None
    wanted: Annotated[WantedPose | None, Field(description="accuracy of the pose at which touching ends")] = None
    dry_run: Annotated[bool, Field(description="only plan: nothing moves")] = False

    @model_validator(mode="after")
    def _names_one_mission(self) -> MissionRequest:
        short = self.actions is not None or self.touches is not None or self.wanted is not None
        given = [key for key in ("file", "mission", "resume") if getattr(self, key) is not None]
        if len(given) + short > 1:
            raise ValueError("give one of file, mission, resume, or actions with touches and wanted")
        return self

    def in_short(self) -> MissionFile:
        """Return the mission of a request without file: it inspects, and then touches and operates what is named."""
        steps: list[Step] = [InspectStep(name="inspect")]
        wanted = self.wanted or WantedPose()
        if self.actions is not None or self.touches is not None:
            touches = USUAL_TOUCHES if self.touches is None else self.touches
            steps.append(FeelStep(name="feel", touches=touches, wanted=wanted))
        for k, action in enumerate(self.actions or ()):
            steps.append(SetStep(name=f"action_{k + 1}", on_failure="skip", **action.model_dump()))
        return MissionFile(steps=tuple(steps))
