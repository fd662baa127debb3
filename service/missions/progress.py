"""What a mission has done so far, in a file beside its report, so that it can be taken up at its first unfinished step."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.atomic_write import write_atomically
from hal.errors import InvalidRequest
from hal.motion import MotionLimits
from hal.strict import validate
from service.schema.mission_file import CallStep, ChooseStep, MissionFile, RepeatStep, Step

FILE = "progress.json"
log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True, eq=False)
class Progress:
    """The finished steps of a mission, by their paths such as `fill/open` or `rounds#2/look`.

    Attributes:
        mission, library: the mission, and the missions that it calls, as they were checked.
        cell, panel: what it runs on; it is taken up on nothing else.
        branches: which branch each `choose` step took.
        path: file that is replaced after each step; None keeps nothing.
    """

    mission: MissionFile
    library: Mapping[str, MissionFile]
    cell: str = ""
    panel: str = ""
    done: list[str] = field(default_factory=list)
    branches: dict[str, str] = field(default_factory=dict)
    path: Path | None = None

    def all_steps(self) -> Iterator[Step]:
        """Yield every step of the mission once, also those within steps and in called missions."""
        yield from _steps_in(self.mission.steps, self.library)

    def limits(self) -> MotionLimits:
        """Return the limits of all motions: of those of the mission and of the missions that it calls, the strictest."""
        given = [file.limits for file in (self.mission, *self.library.values())]
        speeds = [one.speed_m_per_s for one in given if one.speed_m_per_s is not None]
        forces = [one.force_n for one in given if one.force_n is not None]
        return MotionLimits(speed_m_per_s=min(speeds, default=None), force_n=min(forces, default=None))

    def is_done(self, step: str) -> bool:
        """Return whether the step with that path was finished."""
        return step in self.done

    def note_done(self, step: str) -> None:
        """Note a finished step."""
        if step not in self.done:
            self.done.append(step)
        self.save()

    def note_branch(self, step: str, branch: str) -> None:
        """Note which branch a `choose` step takes."""
        self.branches[step] = branch
        self.save()

    def save(self) -> None:
        """Write the file; without disk space the mission goes on, and cannot be taken up from here."""
        if self.path is None:
            return
        plain: dict[str, Any] = {
            "schema": 1,
            "cell": self.cell,
            "panel": self.panel,
            "mission": _plain(self.mission),
            "library": {name: _plain(file) for name, file in self.library.items()},
            "done": self.done,
            "branches": self.branches,
        }
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self.path, json.dumps(plain))
        except OSError as error:
            log.warning("the progress of the mission cannot be written to %s: %s", self.path, error)


def _steps_in(steps: Sequence[Step], library: Mapping[str, MissionFile]) -> Iterator[Step]:
    for step in steps:
        yield step
        match step:
            case ChooseStep():
                yield from _steps_in((*step.then, *step.otherwise), library)
            case RepeatStep():
                yield from _steps_in(step.steps, library)
            case CallStep():
                yield from _steps_in(library[step.mission].steps, library)


def load_progress(folder: Path, *, cell: str, panel: str) -> Progress:
    """Return the progress of an earlier mission; the new mission keeps it in another file.

    Raises:
        InvalidRequest: there is none, it is damaged, or it belongs to another cell or panel.
    """
    hint = "GET /v1/missions lists the missions; start it anew by its file"
    try:
        plain = json.loads((folder / FILE).read_text(encoding="utf-8"))
        found = Progress(
            mission=validate(plain["mission"], MissionFile, source=f"{folder.name}/{FILE}"),
            library={
                str(name): validate(file, MissionFile, source=f"{folder.name}/{FILE}")
                for name, file in plain["library"].items()
            },
            cell=str(plain["cell"]),
            panel=str(plain["panel"]),
            done=[str(step) for step in plain["done"]],
            branches={str(step): str(branch) for step, branch in plain["branches"].items()},
        )
    except FileNotFoundError:
        raise InvalidRequest(f"mission {folder.name!r} has left no progress", hint=hint) from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidRequest(f"the progress of mission {folder.name!r} is damaged: {error}", hint=hint) from error
    if (found.cell, found.panel) != (cell, panel):
        what = f"mission {folder.name!r} ran on cell {found.cell!r} and panel {found.panel!r}"
        raise InvalidRequest(f"{what}, this is cell {cell!r} and panel {panel!r}", hint=hint)
    return found


def _plain(file: MissionFile) -> dict[str, Any]:
    plain: dict[str, Any] = file.model_dump(mode="json", by_alias=True, exclude_none=True)
    return plain
