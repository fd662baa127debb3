"""Finds, reads and stores mission files: in `missions/` beside the cell file or above it; the shipped ones are only read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from hal.atomic_write import write_atomically
from hal.config import Cell
from hal.errors import ConfigError, InvalidRequest
from hal.strict import faults_in, read_text, refusal, toml_data, validate
from service.errors import FileFault, NoSuchMission, NotPossibleNow
from service.missions.check import Checked, check_mission, faults_of_valid_steps
from service.schema.mission_file import MissionFile
from service.schema.mission_request import MissionRequest

SHIPPED = Path(__file__).parents[2] / "missions"
FILE = "mission file"


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionText:
    """The text of a mission file; `digest` is its SHA-256, `is_shipped` says that it belongs to the package."""

    text: str
    digest: str
    is_shipped: bool


def mission_paths(cell: Cell) -> dict[str, Path]:
    """Return the mission files of a cell by name; a file that is nearer to the cell file hides one of the same name."""
    found: dict[str, Path] = {}
    for folder in _folders(cell):
        for path in sorted(folder.glob("*.toml")):
            found.setdefault(path.stem, path)
    return found


def load_mission(name: str, cell: Cell, *, below: tuple[str, ...] = ()) -> MissionFile:
    """Read the mission file called `name`; `below` as for `parse_mission`.

    Raises:
        ConfigError: there is no such file, or it is malformed; names file, key and remedy.
    """
    paths = mission_paths(cell)
    if name not in paths:
        near = get_close_matches(name, paths, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"missions: {', '.join(sorted(paths)) or 'none'}"
        raise ConfigError(f"there is no mission file {name!r}", hint=hint)
    return parse_mission(read_text(paths[name], FILE), cell, source=str(paths[name]), below=(*below, name))


def parse_mission(text: str, cell: Cell, *, source: str, below: tuple[str, ...] = ()) -> MissionFile:
    """Return a mission from the text of its file.

    Args:
        source: names it in errors.
        below: missions whose calls led to it, so that malformed ones that call each other end.

    Raises:
        ConfigError: it is malformed; names all faults, among them what panel and missions contradict in its well-formed steps.
    """
    data = toml_data(text, source=source)
    malformed = faults_in(data, MissionFile)
    if malformed:

        def load(called: str) -> MissionFile:
            if called in below:
                raise InvalidRequest(f"mission {called!r} calls itself", hint="take one call of the circle out")
            return load_mission(called, cell, below=below)

        raise refusal([*malformed, *faults_of_valid_steps(data.get("steps"), cell.panel, load)], source=source)
    return validate(data, MissionFile, source=source)


def checked_text(name: str, text: str, cell: Cell) -> Checked:
    """Check the text of a mission file that is not stored yet, as `checked_file` does with one that is.

    Raises:
        ConfigError, InvalidRequest: names every fault.
    """
    source = f"missions/{name}.toml"
    mission = parse_mission(text, cell, source=source, below=(name,))

    def load(called: str) -> MissionFile:
        return mission if called == name else load_mission(called, cell)

    return check_mission(mission, cell.panel, load, source=source)


def mission_text(name: str, cell: Cell) -> MissionText:
    """Return the text of a mission file, also of one that is malformed.

    Raises:
        NoSuchMission: the cell has no such file.
        ConfigError: it cannot be read.
    """
    path = mission_paths(cell).get(name)
    if path is None:
        raise NoSuchMission(f"there is no mission file {name!r}", hint="GET /v1/mission-files lists them")
    text = read_text(path, FILE)
    return MissionText(text=text, digest=digest_of(text), is_shipped=path.parent == SHIPPED)


def store_mission(name: str, text: str, cell: Cell, *, replaces: str | None, commit: Callable[[Path], None]) -> None:
    """Check a mission and store it as a file of the cell, in one step: a crash leaves the old or the new file.

    Args:
        replaces: digest of the text that it takes the place of; None for a new mission. So nobody's changes are lost.
        commit: records the change durably before it is made.

    Raises:
        ConfigError, InvalidRequest: it has faults.
        NotPossibleNow: somebody else has changed or made the file; or the cell's files belong to the package.
        FileFault: it cannot be written; the old file is still there.
    """
    checked_text(name, text, cell)
    folder = _own_folder(cell)
    path = folder / f"{name}.toml"
    now = mission_text(name, cell).digest if name in mission_paths(cell) else None
    if now != replaces:
        what = "there is a mission of that name" if replaces is None else "the mission was changed by somebody else"
        raise NotPossibleNow(f"{name}: {what}", hint="look at the mission as it is now, then save again")
    commit(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text)
    except OSError as error:
        raise FileFault(f"{path} cannot be written: {error}", hint="check permissions and the disk") from error


def digest_of(text: str) -> str:
    """Return the digest by which the text of a mission file is recognised."""
    return hashlib.sha256(text.encode()).hexdigest()


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


def _own_folder(cell: Cell) -> Path:
    """Return the folder for mission files of the cell; it is made when the first one is stored."""
    nearest = next(_folders(cell))
    if nearest != SHIPPED:
        return nearest
    beside = cell.path.resolve().parent
    if beside == SHIPPED.parent / "cells":
        hint = "copy the cell with `panelwright init FOLDER`, and serve the copy"
        raise NotPossibleNow("the missions of this cell belong to the package and are not changed", hint=hint)
    return beside / "missions"


def _folders(cell: Cell) -> Iterator[Path]:
    for folder in cell.path.resolve().parents:
        if (folder / "missions").is_dir():
            yield folder / "missions"
            break
    yield SHIPPED
