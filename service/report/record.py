"""Records the facts of a mission while it runs, in the order in which they become known."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from hal.errors import CellError
from hal.motion import MotionReport
from service.problem import ProblemFields
from service.schema.fuse_results import FuseResult
from service.schema.mission_results import (
    ActionResult,
    ObjectDepth,
    ObjectPlace,
    ReadingResult,
    StepResult,
    SurfaceCheck,
)
from service.schema.results import FittedPlate, FoundBy

# Fields of a record that appear in a report once they are known.
FINDINGS = ("plate_in_scanner", "objects", "fused", "found_by", "by_surfaces", "depths", "not_parked")


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step of the mission, with its wall time and its time on the cell's clock."""

    name: str
    wall_s: float
    cell_s: float
    ok: bool
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A PNG picture of the report."""

    name: str
    title: str
    png: bytes


@dataclass(slots=True, kw_only=True, eq=False)
class MissionRecord:
    """The record of a mission, written by one thread while the mission runs.

    Attributes:
        now_s: the cell's clock.
        plate_in_scanner: the plate's plane in the first scan.
        objects: the position of each object in 3-D.
        fused, found_by: the panel's pose from all sensors, and from the camera alone.
        by_surfaces: results from the objects' surfaces, in addition to layout and vision.
        outcomes: how each step of the mission ended.
        depths: how far the objects stand out of the plate by several camera views, beside the panel file.
        not_parked: why the arm was not parked after an error.
        origin: with what and for whom the mission was done; see `origin_of`.
        crops: picture (PNG) of each object by its name, upright.
        alarms: alarms whose condition holds at the end.
    """

    mission: str
    cell: str
    panel: str
    mode: str
    seed: int
    title: str = ""
    origin: dict[str, Any] = field(default_factory=dict)
    now_s: Callable[[], float]
    started_wall: float = field(default_factory=time.time)
    steps: list[Step] = field(default_factory=list)
    readings: list[ReadingResult] = field(default_factory=list)
    actions: list[ActionResult] = field(default_factory=list)
    outcomes: list[StepResult] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    motions: list[MotionReport] = field(default_factory=list)
    plate_in_scanner: FittedPlate | None = None
    objects: list[ObjectPlace] | None = None
    fused: FuseResult | None = None
    found_by: FoundBy | None = None
    by_surfaces: list[SurfaceCheck] | None = None
    depths: list[ObjectDepth] | None = None
    not_parked: str | None = None
    crops: dict[str, bytes] = field(default_factory=dict)
    alarms: list[dict[str, str]] = field(default_factory=list)
    problem: ProblemFields | None = None
    started_cell_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.started_cell_s = self.now_s()

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Record one step and its duration, also when it fails."""
        wall_s, cell_s = time.monotonic(), self.now_s()
        ok, detail = False, ""
        try:
            yield
            ok = True
        except CellError as error:
            detail = error.what
            raise
        finally:
            self.steps.append(
                Step(
                    name=name,
                    wall_s=time.monotonic() - wall_s,
                    cell_s=self._now_or(cell_s) - cell_s,
                    ok=ok,
                    detail=detail,
                )
            )

    @property
    def succeeded(self) -> bool:
        """Whether every action was confirmed, no step was skipped, and nothing failed."""
        is_whole = all(one.outcome in ("done", "taken over") for one in self.outcomes)
        return self.problem is None and is_whole and all(action.confirmed for action in self.actions)

    def summary(self) -> dict[str, Any]:
        """Return the contents of `report.json`, without the pictures."""
        return {
            "schema": 1,
            "mission": self.mission,
            "title": self.title,
            **self.origin,
            "alarms": self.alarms,
            "crops": [f"crop-{name}.png" for name in self.crops],
            "cell": self.cell,
            "panel": self.panel,
            "mode": self.mode,
            "seed": self.seed,
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.started_wall)),
            "started_cell_s": self.started_cell_s,
            "succeeded": self.succeeded,
            "wall_s": sum(step.wall_s for step in self.steps),
            "cell_s": sum(step.cell_s for step in self.steps),
            "peak_force_n": max((motion.peak_force_n for motion in self.motions), default=0.0),
            "steps": self.steps,
            "readings": self.readings,
            "actions": self.actions,
            "mission_steps": self.outcomes,
            **{name: value for name in FINDINGS if (value := getattr(self, name)) is not None},
            "pictures": [f"{picture.name}.png" for picture in self.pictures],
            "problem": self.problem,
        }

    def _now_or(self, fallback_s: float) -> float:
        try:
            return self.now_s()
        except CellError:
            return fallback_s  # the cell's process ended in this step, which the step's error reports
