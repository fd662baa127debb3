"""The page about reliability names tests and measurements that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "reliability.md").read_text(encoding="utf-8")


def test_what_shows_a_promise_exists() -> None:
    tests = set(re.findall(r"`(tests/[\w/]+\.py)`", PAGE))
    benchmarks = set(re.findall(r"`python -m (benchmarks\.\w+)`", PAGE))
    assert len(tests) > 10 and len(benchmarks) > 5
    missing = [path for path in tests if not (ROOT / path).is_file()]
    missing += [name for name in benchmarks if not (ROOT / f"{name.replace('.', '/')}.py").is_file()]
    assert missing == []


def test_every_test_that_the_page_names_exists() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", PAGE)
    assert len(named) > 20
    missing = [
        f"{path}::{name}" for path, name in named if f"def {name}(" not in (ROOT / path).read_text(encoding="utf-8")
    ]
    assert missing == []


def test_every_promise_of_the_table_names_a_test() -> None:
    _, _, table = PAGE.partition("| promise | tests | figures |")
    rows = [line for line in table.partition("\n## ")[0].splitlines()[2:] if line.startswith("|")]
    assert len(rows) > 10
    assert [row for row in rows if "tests/" not in row.split("|")[2]] == []
