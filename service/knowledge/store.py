"""Stores kinds and panels that users taught as TOML in one folder; they take precedence over the shipped ones."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from hal.atomic_write import flush_folder, write_atomically
from hal.errors import InvalidRequest
from hal.panel import Panel, load_panel
from service.errors import NoSuchTask

if TYPE_CHECKING:
    from hal.config import Cell
    from perception.vision import Knowledge, TaughtKind

FOLDER = "knowledge"
PLAIN_NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")


class NoSuchKnowledge(NoSuchTask):
    """There is no taught or shipped kind or panel with that name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KindSummary:
    """Typical size of a kind on the plate, and the number of its examples."""

    width_m: float
    height_m: float
    looks: int


@dataclass(frozen=True, slots=True, kw_only=True)
class KnowledgeFile:
    """One file of the knowledge; it is shipped with the system unless `is_taught`.

    `of_cell`: the file with the appearance examples that the cell's own panel adds to it.
    """

    name: str
    path: Path
    is_taught: bool
    of_cell: Path | None = None

    def text(self) -> str:
        """Return its TOML, with the examples of the cell's own panel at the end."""
        if self.path.suffix == ".toml" and self.of_cell is None:
            return self.path.read_text(encoding="utf-8")
        return _text_of(*(_stamped(path) for path in (self.path, self.of_cell) if path is not None))

    def summary(self) -> KindSummary:
        """Return a summary of a kind's file, without its feature values.

        Raises:
            ConfigError: the file is malformed.
        """
        own, *added = (_kind_in(_stamped(path)) for path in (self.path, self.of_cell) if path is not None)
        width_m, height_m = own.size_m
        return KindSummary(width_m=width_m, height_m=height_m, looks=sum(len(kind.looks) for kind in (own, *added)))


class KnowledgeStore:
    """Stores kinds in `folder/*.toml` and panels in `folder/panels/*.toml`; `of_cell` adds examples to shipped kinds."""

    _lock = threading.Lock()  # shared by all instances of this process, so that no concurrent lesson is lost

    def __init__(self, folder: Path, *, of_cell: Path | None = None) -> None:
        self.folder = folder
        self.of_cell = of_cell

    @classmethod
    def of_runs(cls, runs_dir: Path, cell: Cell) -> KnowledgeStore:
        """Return the store of a service, in addition to the folder that its cell file names."""
        return cls(runs_dir / FOLDER, of_cell=cell.knowledge_path)

    def knowledge(self) -> Knowledge:
        """Return the shipped kinds with the examples of the cell's own panel; taught kinds replace those of the same name.

        Raises:
            ConfigError: a file of a folder is malformed; the error names it.
        """
        from perception.vision import Knowledge

        shipped = _shipped() if self.of_cell is None else _with_looks_in(self.of_cell, _stamps(self.of_cell))
        if not _kinds_of(self.folder):
            return shipped
        taught = _kinds_in(self.folder, _stamps(self.folder)).kinds
        names = {kind.name for kind in taught}
        kinds = (*(kind for kind in shipped.kinds if kind.name not in names), *taught)
        return Knowledge(kinds=kinds, spread=shipped.spread)  # of the shipped examples

    def kinds(self) -> list[KnowledgeFile]:
        """Return the files of all kinds in use, ordered by name."""
        files = {path.stem: KnowledgeFile(name=path.stem, path=path, is_taught=False) for path in _kinds_of(None)}
        for path in () if self.of_cell is None else _kinds_of(self.of_cell):
            known = files.get(path.stem)
            files[path.stem] = (
                KnowledgeFile(name=path.stem, path=path, is_taught=False)
                if known is None
                else replace(known, of_cell=path)
            )
        taught = _kinds_of(self.folder)
        files |= {path.stem: KnowledgeFile(name=path.stem, path=path, is_taught=True) for path in taught}
        return [files[name] for name in sorted(files)]

    def panels(self) -> list[KnowledgeFile]:
        """Return the files of the taught panels, ordered by name."""
        folder = self.folder / "panels"
        return [KnowledgeFile(name=path.stem, path=path, is_taught=True) for path in _toml(folder)]

    def panel(self, name: str) -> Panel:
        """Return a taught panel.

        Raises:
            NoSuchKnowledge: it was not taught.
            ConfigError: its file is malformed.
        """
        for file in self.panels():
            if file.name == name:
                return load_panel(file.path)
        raise NoSuchKnowledge("no panel of that name was taught", hint="GET /v1/knowledge lists what is known")

    def write_kind(self, kind: TaughtKind) -> Path:
        """Store a taught kind and replace one of the same name."""
        from perception.vision import write_kind

        check_name(kind.name)
        with self._lock:
            self.folder.mkdir(parents=True, exist_ok=True)
            return write_kind(kind, self.folder)

    def write_panel(self, name: str, text: str) -> Path:
        """Store a taught panel and replace one of the same name."""
        check_name(name)
        folder = self.folder / "panels"
        with self._lock:
            folder.mkdir(parents=True, exist_ok=True)
            return write_atomically(folder / f"{name}.toml", text)

    def forget(self, group: str, name: str) -> None:
        """Delete a taught kind or panel; a shipped kind of that name is in use again.

        Raises:
            NoSuchKnowledge: it was not taught.
        """
        files = {"kinds": self.kinds, "panels": self.panels}[group]()
        file = next((file for file in files if file.name == name and file.is_taught), None)
        if file is None:
            raise NoSuchKnowledge(
                "no taught kind or panel has that name",
                hint="a shipped kind cannot be deleted; teach it again to replace it",
            )
        file.path.unlink(missing_ok=True)
        flush_folder(file.path.parent)


def check_name(name: str) -> None:
    """Raise `InvalidRequest` for a name that cannot be used for files and objects."""
    if not PLAIN_NAME.fullmatch(name):
        raise InvalidRequest(f"{name[:40]!r} is no name of a kind or panel", hint="small letters, digits, underscores")


def _toml(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.glob("*.toml")) if PLAIN_NAME.fullmatch(path.stem))


def _kinds_of(folder: Path | None) -> list[Path]:
    """Return the files of the kinds in a folder (None: the shipped ones); none if the folder does not exist."""
    from perception.vision import kind_files

    return [path for path in kind_files(folder) if PLAIN_NAME.fullmatch(path.stem)]


def _stamps(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Return stamps of a folder's files, which show whether a file has changed since it was read."""
    return tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in _kinds_of(folder))


@lru_cache(maxsize=8)
def _kinds_in(folder: Path, stamps: tuple[tuple[str, int, int], ...]) -> Knowledge:
    """Read the kinds of a folder; cached by the stamps of its files."""
    del stamps
    from perception.vision import load_knowledge

    return load_knowledge(folder)


@lru_cache(maxsize=1)
def _shipped() -> Knowledge:
    from perception.vision import load_knowledge

    return load_knowledge()


@lru_cache(maxsize=8)
def _with_looks_in(folder: Path, stamps: tuple[tuple[str, int, int], ...]) -> Knowledge:
    """Return the shipped kinds with the examples of a cell's folder; cached by the stamps of its files."""
    return _shipped().with_looks_of(_kinds_in(folder, stamps).kinds)


def _stamped(path: Path) -> tuple[Path, int]:
    """Return a file with its stamp, which shows whether it has changed since it was read."""
    return path, path.stat().st_mtime_ns


@lru_cache(maxsize=256)
def _kind_in(stamped: tuple[Path, int]) -> TaughtKind:
    from perception.vision import load_kind

    return load_kind(stamped[0])


@lru_cache(maxsize=256)
def _text_of(*stamped: tuple[Path, int]) -> str:
    """Return as TOML a kind that is not stored as TOML, or whose examples are in two files."""
    from perception.vision import kind_text

    own, *added = (_kind_in(each) for each in stamped)
    for kind in added:
        own = own.joined(kind)
    return kind_text(own)
