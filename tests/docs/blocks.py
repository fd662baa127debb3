"""The code blocks of the pages, and what each says about how it is tested."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUNNABLE = frozenset({"python", "bash", "sh", "console", "shell"})
_BLOCK = re.compile(
    r"(?:<!-- (?P<mark>fragment|test): (?P<said>[^\n]*?) -->\n+)?```(?P<language>\w+)\n(?P<code>.*?)```", re.DOTALL
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """One fenced block of a page.

    Attributes:
        mark: "fragment" for a block that nobody can run as it stands, "test" for one that a test of its own runs, else "".
        said: the reason of a fragment, or the test's `file::function`.
    """

    page: Path
    language: str
    code: str
    mark: str
    said: str


def blocks() -> Iterator[Block]:
    """Every Python and shell block of every page, in order."""
    for page in PAGES:
        for found in _BLOCK.finditer(page.read_text(encoding="utf-8")):
            if found["language"] in RUNNABLE:
                yield Block(
                    page=page,
                    language=found["language"],
                    code=found["code"],
                    mark=found["mark"] or "",
                    said=found["said"] or "",
                )


def page_name(page: Path) -> str:
    """The path of a page within the tree."""
    return page.relative_to(ROOT).as_posix()
