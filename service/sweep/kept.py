"""Keeps each panel of a sweep as it ends, so that a sweep that was interrupted goes on where it stood."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hal.atomic_write import write_atomically
from hal.errors import ConfigError
from service.sweep.ask import PanelRun
from service.sweep.judge import JudgedDeed, Verdict
from service.sweep.options import SweepOptions

FOLDER = "panels"
OPTIONS = "options.json"
RANGE = re.compile(r"(\d{1,10})(?:-(\d{1,10}))?")
log = logging.getLogger(__name__)


class Kept:
    """The finished panels of a sweep, one file each in `panels/` below its folder.

    A panel that could not run is not kept, so that it is tried again.

    Args:
        folder: of the sweep.
        options: of the sweep; the panels of a sweep with others, or of a cell file that was changed, do not count.

    Raises:
        ConfigError: the folder has panels of another sweep.
    """

    def __init__(self, folder: Path, options: SweepOptions) -> None:
        self._folder = folder / FOLDER
        said = _said(options)
        path = folder / OPTIONS
        if path.exists() and any(self._folder.glob("*.json")) and json.loads(path.read_text("utf-8")) != said:
            raise ConfigError(
                f"{folder} has panels of a sweep with other options, or of another state of its cell file",
                hint="give another folder with --out, or move that one away",
            )
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(said, indent=1) + "\n")

    def run_of(self, seed: int) -> PanelRun | None:
        """Return the panel of a seed; None if it has not ended, or its file is damaged."""
        try:
            return run_from(json.loads(self._path(seed).read_text(encoding="utf-8")))
        except FileNotFoundError:
            return None
        except (ValueError, LookupError, TypeError) as error:
            log.warning("%s is damaged, so that panel is run again: %s", self._path(seed), error)
            return None

    def keep(self, run: PanelRun) -> None:
        """Keep a panel that has ended."""
        if not run.problem:
            write_atomically(self._path(run.seed), json.dumps(asdict(run)) + "\n")

    def _path(self, seed: int) -> Path:
        return self._folder / f"{seed}.json"


def run_from(plain: dict[str, Any]) -> PanelRun:
    """Return a panel from its JSON values.

    Raises:
        LookupError, TypeError, ValueError: something is missing or of another kind.
    """
    deeds = tuple(_deed_from(deed) for deed in plain["deeds"])
    right, given = plain["readings"]
    return PanelRun(**{**plain, "deeds": deeds, "readings": (int(right), int(given))})


def seeds_of(text: str) -> list[int]:
    """Return the seeds in a list such as `1-1000` or `1-20,40`, each once, in the order given.

    Raises:
        ConfigError: it is no such list.
    """
    try:
        found = list(dict.fromkeys(_ranges(text)))
    except ValueError:
        found = []
    if not found:
        raise ConfigError(f"{text!r} is no list of seeds", hint="write for example 1-1000 or 1-20,40")
    return found


def _ranges(text: str) -> Iterator[int]:
    for part in text.split(","):
        found = RANGE.fullmatch(part.strip())
        if found is None:
            raise ValueError(part)
        yield from range(int(found[1]), int(found[2] or found[1]) + 1)


def _deed_from(plain: dict[str, Any]) -> JudgedDeed:
    lists = {name: tuple(plain[name]) for name in ("moved_unasked", "touched_unasked")}
    return JudgedDeed(**{**plain, **lists, "verdict": Verdict(plain["verdict"])})


def _said(options: SweepOptions) -> dict[str, Any]:
    """Return what the panels of a sweep depend on."""
    return {
        "cell": options.cell.read_text(encoding="utf-8"),
        "only": list(options.only),
        "known_pose": options.known_pose,
        "mission": options.mission,
    }
