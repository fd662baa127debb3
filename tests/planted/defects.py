"""Reads the list of planted defects and applies one of them to a copy of the sources."""

from __future__ import annotations

import ast
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).parent / "defects.toml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Defect:
    """A small change of one file in the safety path that some test must find.

    Attributes:
        name: the consequence of the defect, as a sentence.
        old: text that occurs exactly once in `file`; `new` takes its place.
        tests: the nearest tests, as arguments of pytest.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def planted(self, source: str) -> str:
        """Return the source with the defect.

        Raises:
            ValueError: `old` does not occur exactly once, or the result is no Python.
        """
        count = source.count(self.old)
        if count != 1:
            raise ValueError(f"{self.name}: the old text occurs {count} times in {self.file}; it must occur once")
        changed = source.replace(self.old, self.new)
        try:
            ast.parse(changed)
        except SyntaxError as error:
            raise ValueError(f"{self.name}: {self.file} would be no Python: {error}") from error
        return changed


def all_defects() -> list[Defect]:
    """Return the planted defects in the order of the list."""
    rows = tomllib.loads(LIST.read_text(encoding="utf-8"))["defect"]
    return [Defect(**{**row, "tests": tuple(row["tests"])}) for row in rows]
