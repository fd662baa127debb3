"""The table of faults names tests and faults of chaos that exist."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.faults import table
from service.chaos.faults import FAULTS

ROOT = Path(__file__).parents[2]


def test_every_fault_has_a_test_and_every_test_exists() -> None:
    rows = table()
    assert list(rows) == [f"F{number}" for number in range(1, 39)]
    for name, row in rows.items():
        assert row["tests"], name
        for node in row["tests"]:
            file, _, test = node.partition("::")
            assert re.search(rf"^def {test}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), (name, node)


def test_every_fault_of_chaos_belongs_to_one_of_the_table() -> None:
    known = {fault.name for fault in FAULTS}
    named = {fault for row in table().values() for fault in row.get("chaos", [])}
    assert named <= known
    assert known - named == {"kill stop", "hang cell", "hang world", "hang stop"}, "these are losses: benchmarks.losses"
