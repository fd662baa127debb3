"""`panelwright journal`: rows as people read them, whole for programs, and the chain walked on request."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.commands.journal import WIDTH, journal
from service.errors import FileFault, JournalError
from service.tasks.journal import Journal


@pytest.fixture
def runs(tmp_path: Path) -> Iterator[Path]:
    """The folder of a service that still writes."""
    writer = Journal(tmp_path / ".service" / "journal.sqlite")
    writer.append("service-start", {"cell": "[bench]", "mode": "sim"})
    writer.append("stop", {"source": "the page", "key": None})
    writer.append("task-ended", {"state": "failed", "hint": "one\ntwo", "trace": "x" * 500})
    yield tmp_path
    writer.close()


def test_a_row_is_a_line_with_its_time_its_kind_and_what_it_says(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    journal(runs=runs)
    first, second, third = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r" +1  \d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}  service-start    cell \[bench], mode sim", first)
    assert second.endswith("stop             source the page")
    assert "state failed, hint one two, trace xxx" in third and third.endswith("x…")
    assert len(third.split("task-ended       ")[1]) == WIDTH


def test_kinds_and_the_newest_rows_can_be_asked_for(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal(runs=runs, kind=["stop", "service-start"], last=1, as_json=True)
    row = json.loads(capsys.readouterr().out)
    assert (row["id"], row["kind"], row["data"]) == (2, "stop", {"source": "the page", "key": None})


def test_a_kind_that_no_row_has_is_answered_with_those_there_are(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    journal(runs=runs, kind=["stops"])
    told = " ".join(capsys.readouterr().out.split())
    assert told == "no row is of kind stops; there are service-start, stop, task-ended"
    journal(runs=runs, kind=["stops"], as_json=True)
    assert capsys.readouterr().out == ""


def test_the_chain_is_whole_until_somebody_changes_a_row(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal(runs=runs, verify=True)
    assert capsys.readouterr().out.endswith("3 rows, the chain is intact\n")
    with sqlite3.connect(runs / ".service" / "journal.sqlite") as db:
        db.execute("UPDATE journal SET data = '{}' WHERE id = 2")
    with pytest.raises(JournalError, match="the chain breaks at row 2"):
        journal(runs=runs, verify=True)


def test_no_journal_and_what_is_none_are_told_by_name(tmp_path: Path) -> None:
    with pytest.raises(FileFault, match=r"there is no journal .*journal\.sqlite"):
        journal(runs=tmp_path)
    (tmp_path / ".service").mkdir()
    (tmp_path / ".service" / "journal.sqlite").write_text("not a database")
    for verify in (False, True):
        with pytest.raises(JournalError, match="cannot be read: file is not a database"):
            journal(runs=tmp_path, verify=verify)
