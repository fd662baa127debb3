"""Finds mission files: in `missions/` beside the cell file or above it, then among the shipped ones."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path

from hal.config import Cell
from hal.errors import ConfigError
from hal.strict import load_toml
from service.missions.check import Checked, check_mission
from service.schema.mission_file import MissionFile
from service.schema.mission_request import MissionRequest

SHIPPED = Path(__file__).parents[2] / "missions"


def mission_paths(cell: Cell) -> dict[str, Path]:
    """Return the mission files of a cell by name; a file that is nearer to the cell file hides one of the same name."""
    found: dict[str, Path] = {}
    for folder in _folders(cell):
        for path in sorted(folder.glob("*.toml")):
            found.setdefault(path.stem, path)
    return found


def load_mission(name: str, cell: Cell) -> MissionFile:
    """Read the mission file called `name`.

    Raises:
        ConfigError: there is no such file, or it is malformed; names file, key and remedy.
    """
    paths = mission_paths(cell)
    if name not in paths:
        near = get_close_matches(name, paths, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"missions: {', '.join(sorted(paths)) or 'none'}"
        raise ConfigError(f"there is no mission file {name!r}", hint=hint)
    return load_toml(paths[name], MissionFile, "mission file")


def checked_file(name: str, cell: Cell) -> Checked:
    """Read a mission file and check it, and all that it calls, against the cell's panel.

    Raises:
        ConfigError, InvalidRequest: names every fault of the file.
    """
    return checked(load_mission(name, cell), cell, source=f"missions/{name}.toml")


def checked(mission: MissionFile, cell: Cell, *, source: str) -> Checked:
    """Check a mission against the cell's panel; see `check_mission`."""
    return check_mission(mission, cell.panel, lambda name: load_mission(name, cell), source=source)


def mission_of(request: MissionRequest, cell: Cell) -> Checked:
    """Return the mission of a request that does not take one up, checked against the cell's panel.

    Raises:
        ConfigError, InvalidRequest: names every fault.
    """
    if request.file is not None:
        return checked_file(request.file, cell)
    if request.mission is not None:
        return checked(request.mission, cell, source="mission")
    return Checked(mission=request.in_short(), library={})


def _folders(cell: Cell) -> Iterator[Path]:
    for folder in cell.path.resolve().parents:
        if (folder / "missions").is_dir():
            yield folder / "missions"
            break
    yield SHIPPED
