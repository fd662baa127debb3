"""What users taught: kinds and panels as readable TOML in one folder, before the shipped ones and those of the cell."""

from __future__ import annotations

import re
import threading
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from hal.atomic_write import write_atomically
from hal.errors import ConfigError, InvalidRequest
from hal.panel import Panel, load_panel
from service.errors import NoSuchTask

if TYPE_CHECKING:
    from hal.config import Cell
    from perception.vision import Knowledge, TaughtKind

FOLDER = "knowledge"
SHIPPED = Path(__file__).parents[2] / "perception" / "vision" / "knowledge"
PLAIN_NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")


class NoSuchKnowledge(NoSuchTask):
    """Nothing of that name was taught or shipped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KindSummary:
    """Size on the plate of a typical one, and how many examples taught it."""

    width_m: float
    height_m: float
    looks: int


@dataclass(frozen=True, slots=True, kw_only=True)
class KnowledgeFile:
    """One TOML file of the knowledge; `is_taught` False: shipped with the system.

    `of_cell`: the file with the looks that the cell's own panel adds to it.
    """

    name: str
    path: Path
    is_taught: bool
    of_cell: Path | None = None

    def text(self) -> str:
        """Its TOML, with the looks of the cell's own panel at its end."""
        text = self.path.read_text(encoding="utf-8")
        if self.of_cell is None:
            return text
        _, mark, looks = self.of_cell.read_text(encoding="utf-8").partition("\n[[looks]]")
        return f"{text}\n# of the cell's own panel\n{mark}{looks}"

    def summary(self) -> KindSummary:
        """What a kind's file says, without the numbers of its looks.

        Raises:
            ConfigError: it is malformed.
        """
        own = _summary(self.path, self.path.stat().st_mtime_ns)
        if self.of_cell is None:
            return own
        added = _summary(self.of_cell, self.of_cell.stat().st_mtime_ns)
        return replace(own, looks=own.looks + added.looks)


class KnowledgeStore:
    """Kinds in `folder/*.toml`, panels in `folder/panels/*.toml`; `of_cell` holds looks that add to the shipped kinds."""

    _lock = threading.Lock()  # of all of this process: two lessons at once must not lose one

    def __init__(self, folder: Path, *, of_cell: Path | None = None) -> None:
        self.folder = folder
        self.of_cell = of_cell

    @classmethod
    def of_runs(cls, runs_dir: Path, cell: Cell) -> KnowledgeStore:
        """Where a service keeps them, over what its cell file names."""
        return cls(runs_dir / FOLDER, of_cell=cell.knowledge_path)

    def knowledge(self) -> Knowledge:
        """The shipped kinds with the looks of the cell's own panel, each replaced by the folder's own of that name.

        Raises:
            ConfigError: a file of a folder is malformed; names it.
        """
        from perception.vision import Knowledge

        shipped = _kinds_in(SHIPPED, _stamps(SHIPPED))
        if self.of_cell is not None:
            shipped = _with_looks_in(self.of_cell, _stamps(self.of_cell), _stamps(SHIPPED))
        if not any(self.folder.glob("*.toml")):
            return shipped
        taught = _kinds_in(self.folder, _stamps(self.folder)).kinds
        names = {kind.name for kind in taught}
        kinds = (*(kind for kind in shipped.kinds if kind.name not in names), *taught)
        return Knowledge(kinds=kinds, spread=shipped.spread)  # the unit of likeness stays what the shipped looks gave

    def kinds(self) -> list[KnowledgeFile]:
        """Files of all kinds in use, by name."""
        files = {path.stem: KnowledgeFile(name=path.stem, path=path, is_taught=False) for path in _toml(SHIPPED)}
        files.pop("proportions", None)  # how parts lie in a panel meter: no kind
        for path in () if self.of_cell is None else _toml(self.of_cell):
            known = files.get(path.stem)
            files[path.stem] = (
                KnowledgeFile(name=path.stem, path=path, is_taught=False)
                if known is None
                else replace(known, of_cell=path)
            )
        files |= {path.stem: KnowledgeFile(name=path.stem, path=path, is_taught=True) for path in _toml(self.folder)}
        return [files[name] for name in sorted(files)]

    def panels(self) -> list[KnowledgeFile]:
        """Files of the taught panels, by name."""
        folder = self.folder / "panels"
        return [KnowledgeFile(name=path.stem, path=path, is_taught=True) for path in _toml(folder)]

    def panel(self, name: str) -> Panel:
        """A taught panel.

        Raises:
            NoSuchKnowledge: nobody taught it.
            ConfigError: its file is malformed.
        """
        for file in self.panels():
            if file.name == name:
                return load_panel(file.path)
        raise NoSuchKnowledge("no panel of that name was taught", hint="GET /v1/knowledge lists what is known")

    def write_kind(self, kind: TaughtKind) -> Path:
        """Keep a taught kind, in place of the one of that name."""
        from perception.vision import write_kind

        check_name(kind.name)
        with self._lock:
            self.folder.mkdir(parents=True, exist_ok=True)
            return write_kind(kind, self.folder)

    def write_panel(self, name: str, text: str) -> Path:
        """Keep a taught panel, in place of the one of that name."""
        check_name(name)
        folder = self.folder / "panels"
        with self._lock:
            folder.mkdir(parents=True, exist_ok=True)
            return write_atomically(folder / f"{name}.toml", text)

    def forget(self, group: str, name: str) -> None:
        """Delete a taught kind or panel; a shipped kind of that name is in use again.

        Raises:
            NoSuchKnowledge: nobody taught it.
        """
        files = {"kinds": self.kinds, "panels": self.panels}[group]()
        file = next((file for file in files if file.name == name and file.is_taught), None)
        if file is None:
            raise NoSuchKnowledge("nobody taught that", hint="what is shipped cannot be deleted; teach it anew instead")
        file.path.unlink(missing_ok=True)


def check_name(name: str) -> None:
    """Raise `InvalidRequest` for what cannot be a file's and an object's name."""
    if not PLAIN_NAME.fullmatch(name):
        raise InvalidRequest(f"{name[:40]!r} is no name of a kind or panel", hint="small letters, digits, underscores")


def _toml(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.glob("*.toml")) if PLAIN_NAME.fullmatch(path.stem))


def _stamps(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """What tells that a folder's files are as they were when they were read."""
    return tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in sorted(folder.glob("*.toml")))


@lru_cache(maxsize=8)
def _kinds_in(folder: Path, stamps: tuple[tuple[str, int, int], ...]) -> Knowledge:
    """The kinds of a folder, read once: they are two megabytes of numbers."""
    del stamps
    from perception.vision import load_knowledge

    return load_knowledge(folder)


@lru_cache(maxsize=8)
def _with_looks_in(
    folder: Path, stamps: tuple[tuple[str, int, int], ...], shipped: tuple[tuple[str, int, int], ...]
) -> Knowledge:
    """The shipped kinds with the looks of a cell's folder."""
    return _kinds_in(SHIPPED, shipped).with_looks_of(_kinds_in(folder, stamps).kinds)


@lru_cache(maxsize=256)
def _summary(path: Path, stamp_ns: int) -> KindSummary:
    del stamp_ns
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        return KindSummary(width_m=float(data["width_m"]), height_m=float(data["height_m"]), looks=len(data["looks"]))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"knowledge file {path} is malformed: {error}",
            hint="mend it, or delete it and teach the kind again",
            file=str(path),
        ) from error
