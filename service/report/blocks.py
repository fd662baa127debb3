"""The blocks of a report: titles, texts, tables and figures, before they become a page or a PDF."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Title:
    """The title, and the line below it."""

    text: str
    below: str


@dataclass(frozen=True, slots=True)
class Heading:
    """The heading of a part."""

    text: str


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph; `look` is made of `verdict`, `ok`, `bad` and `soft`."""

    text: str
    look: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """Numbers with what they mean, beside each other."""

    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a table: a text, or the file of a picture."""

    text: str = ""
    look: str = ""
    picture: str | None = None


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the columns of `numbers` are set to the right."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    numbers: AbstractSet[int] = frozenset()


@dataclass(frozen=True, slots=True)
class Figures:
    """Pictures by file name with their captions, so many in a row."""

    items: tuple[tuple[str, str], ...]
    across: int = 2


@dataclass(frozen=True, slots=True)
class Appendix:
    """Here a new page begins, with the appendix."""

    text: str = "Appendix"


Block = Title | Heading | Text | Facts | Table | Figures | Appendix


def mark(text: str, *, is_good: bool) -> Cell:
    """Return a cell that is green or red."""
    return Cell(text, "ok" if is_good else "bad")


def label_in(summary: dict[str, Any], name: str) -> str:
    """Return the label of an object as people read it on the panel, or its name."""
    return str((summary.get("labels") or {}).get(name) or name.replace("_", " "))
