"""Code blocks of the documentation pages, and how each states that it is tested."""

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
    """Fenced block of a page.

    Attributes:
        mark: "fragment" for a block that cannot be run unchanged, "test" for one that a separate test runs, else "".
        said: the reason of a fragment, or the test's `file::function`.
    """

    page: Path
    language: str
    code: str
    mark: str
    said: str


def blocks() -> Iterator[Block]:
    """Yield the Python and shell blocks of all pages, in order."""
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
    """Return the path of a page relative to the repository."""
    return page.relative_to(ROOT).as_posix()
