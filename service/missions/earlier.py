"""What the files of an earlier mission tell about it; read again only when they have changed."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.missions.progress import FILE

REPORT = "report.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """An earlier mission. A file that is missing or damaged leaves its part empty.

    Attributes:
        started: when it began, UTC, ISO 8601; from its report, because the file's time changes with a copy.
        objects: those that it read or operated, by name.
        unfinished_step: name of the first of its steps that is not done.
    """

    started: str = ""
    title: str = ""
    succeeded: bool | None = None
    objects: tuple[str, ...] = ()
    unfinished_step: str | None = None


def told_of(folder: Path) -> Told:
    """Return what the mission in a folder has left."""
    report, progress = folder / REPORT, folder / FILE
    return _told(report, _changed_ns(report), progress, _changed_ns(progress))


def _changed_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


@functools.lru_cache(maxsize=10_000)
def _told(report: Path, _report_ns: int, progress: Path, _progress_ns: int) -> Told:
    said, done = _plain(report), _plain(progress)
    mission = done.get("mission")
    mission = mission if isinstance(mission, dict) else {}
    named = {*_names(said.get("readings"), "name"), *_names(said.get("actions"), "object")}
    finished = done["done"] if isinstance(done.get("done"), list) else []
    left = [step for step in _names(mission.get("steps"), "name") if step not in finished]
    return Told(
        started=str(said.get("started", "")),
        title=str(mission.get("title", "")),
        succeeded=said["succeeded"] if isinstance(said.get("succeeded"), bool) else None,
        objects=tuple(sorted(named)),
        unfinished_step=left[0] if left else None,
    )


def _plain(path: Path) -> dict[str, Any]:
    try:
        plain = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return plain if isinstance(plain, dict) else {}


def _names(items: Any, key: str) -> list[str]:
    """Return the names in a list of a file that may be damaged."""
    return (
        [str(item[key]) for item in items if isinstance(item, dict) and key in item] if isinstance(items, list) else []
    )
