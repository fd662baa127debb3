"""The table of faults names tests and faults of chaos that exist."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.faults import passed, table
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


def test_a_test_counts_as_passed_when_all_its_parameters_passed_and_none_was_skipped() -> None:
    report = """<testsuites><testsuite>
      <testcase classname="tests.a" name="test_one"/>
      <testcase classname="tests.a" name="test_two[x]"/>
      <testcase classname="tests.a" name="test_two[y]"><failure message="no"/></testcase>
      <testcase classname="tests.a" name="test_three"><skipped message="why"/></testcase>
    </testsuite></testsuites>"""
    assert passed(report) == {"tests/a.py::test_one"}
