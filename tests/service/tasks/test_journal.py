"""Acknowledged rows of the journal are on disk, even if the writer is killed; the hash chain reveals every change."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest

from service.errors import JournalError
from service.tasks.journal import Journal, _opened
from service.tasks.journal_reader import FIRST_HASH, seal


def test_what_was_appended_is_read_back_in_order(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    for i in range(5):
        journal.append("tick", {"i": i})
    records = journal.records()
    assert [record.data["i"] for record in records] == list(range(5))
    assert records[0].previous_hash == FIRST_HASH
    assert journal.records(kinds=("tock",)) == []
    assert [r.data["i"] for r in journal.records(limit=2)] == [3, 4]
    assert journal.verify() == 5
    journal.close()


def test_it_goes_on_after_a_restart(tmp_path: Path) -> None:
    for i in range(3):
        journal = Journal(tmp_path / "j.sqlite")
        journal.append("run", {"i": i})
        journal.close()
    journal = Journal(tmp_path / "j.sqlite")
    assert journal.verify() == 3
    journal.close()


def test_many_threads_share_commits_and_break_nothing(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    threads = [
        threading.Thread(target=lambda n=n: [journal.append("t", {"n": n, "i": i}) for i in range(20)])
        for n in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert journal.verify() == 160
    journal.close()


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE journal SET data = '{\"i\":99}' WHERE id = 3",
        "UPDATE journal SET kind = 'x' WHERE id = 3",
        "UPDATE journal SET wall_time_s = 0 WHERE id = 3",
        "DELETE FROM journal WHERE id = 3",
        "DELETE FROM journal WHERE id = 1",
        "UPDATE journal SET previous_hash = 'y' WHERE id = 5",
    ],
)
def test_every_change_breaks_the_chain(tmp_path: Path, change: str) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    for i in range(5):
        journal.append("tick", {"i": i})
    journal.close()
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        db.execute(change)
    with pytest.raises(JournalError, match="chain breaks at row"):
        journal.verify()


@pytest.mark.parametrize("head", ["", "UPDATE head SET last_id = 2", "DELETE FROM head"])
def test_a_chain_whose_end_was_cut_off_is_told(tmp_path: Path, head: str) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    for i in range(5):
        journal.append("tick", {"i": i})
    journal.close()
    assert journal.verify() == 5
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        db.execute("DELETE FROM journal WHERE id > 2")
        db.execute(head or "SELECT 1")
    with pytest.raises(JournalError, match="ends at row 2, but its sealed head names"):
        journal.verify()


def test_only_its_user_may_read_the_key_of_a_journal_and_an_older_journal_gets_one(tmp_path: Path) -> None:
    Journal(tmp_path / "j.sqlite").close()
    assert (tmp_path / "j.key").stat().st_mode & 0o077 == 0
    (tmp_path / "j.key").unlink()
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        db.execute("DROP TABLE head")
    journal = Journal(tmp_path / "j.sqlite")
    journal.append("tick", {})
    assert journal.verify() == 1
    journal.close()


def test_a_seal_is_worth_nothing_without_the_key_of_its_journal() -> None:
    assert seal(b"a" * 32, 7, "x") != seal(b"b" * 32, 7, "x")
    assert len({seal(b"a" * 32, 7, "x"), seal(b"a" * 32, 8, "x"), seal(b"a" * 32, 7, "y")}) == 3


def test_every_commit_is_flushed_because_a_power_cut_is_harder_than_a_kill(tmp_path: Path) -> None:
    """No test can cut the power, so this one asks SQLite (https://sqlite.org/pragma.html#pragma_synchronous)."""
    with closing(_opened(tmp_path / "j.sqlite", b"key")) as db:
        assert db.execute("PRAGMA synchronous").fetchone() == (2,), "FULL"
        assert db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


SMALL = 60_000  # some hundred rows of `filled`


def filled(journal: Journal, numbers: range) -> None:
    for i in numbers:
        journal.append("tick", {"i": i, "text": "x" * 500})


def files_of(journal: Journal) -> list[str]:
    return sorted(path.name for path in journal.path.parent.iterdir() if path.suffix == ".sqlite")


def test_a_journal_that_grows_is_divided_and_read_and_verified_as_one(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite", part_bytes=SMALL, keep_parts=100)
    filled(journal, range(400))
    journal.close()
    assert len(files_of(journal)) >= 4
    assert max(path.stat().st_size for path in tmp_path.glob("*.sqlite")) < 1.5 * SMALL
    journal = Journal(tmp_path / "j.sqlite", part_bytes=SMALL, keep_parts=100)
    filled(journal, range(400, 420))
    assert [record.data["i"] for record in journal.records()] == list(range(420))
    assert [record.data["i"] for record in journal.records(kinds=("tick",), limit=250)] == list(range(170, 420))
    assert [record.id for record in journal.records()] == list(range(1, 421))
    assert journal.verify() == 420
    journal.close()


def test_the_disk_that_it_takes_is_bounded_and_the_chain_says_what_went(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite", part_bytes=SMALL, keep_parts=2)
    filled(journal, range(600))
    journal.close()
    assert len(files_of(journal)) == 3
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 4 * SMALL
    kept = [record.data["i"] for record in journal.records(kinds=("tick",))]
    assert kept == list(range(kept[0], 600))
    gone = journal.records(kinds=("journal-dropped",))[-1].data
    assert journal.records()[0].id == gone["id"] + 1
    assert journal.verify() == len(journal.records())
    (tmp_path / files_of(journal)[0]).unlink()
    with pytest.raises(JournalError, match="chain breaks at row"):
        journal.verify()


def test_two_services_on_one_folder_divide_one_chain(tmp_path: Path) -> None:
    both = [Journal(tmp_path / "j.sqlite", part_bytes=SMALL, keep_parts=100) for _ in range(2)]
    for i in range(300):
        filled(both[i % 2], range(i, i + 1))
    assert [record.data["i"] for record in both[0].records()] == list(range(300))
    for journal in both:
        assert journal.verify() == 300
        journal.close()


def test_who_reads_while_it_is_divided_misses_nothing(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite", part_bytes=SMALL, keep_parts=100)
    filled(journal, range(10))
    writer = threading.Thread(target=filled, args=(journal, range(10, 500)))
    writer.start()
    while writer.is_alive():
        seen = [record.id for record in journal.records()]
        assert seen == list(range(1, len(seen) + 1))
        assert journal.verify() >= len(seen)
    writer.join()
    journal.close()


def test_rows_that_could_only_be_copied_are_told_once_and_written_on(tmp_path: Path) -> None:
    """The rows are as after a crash between the copy and the deletion."""
    journal = Journal(tmp_path / "j.sqlite", part_bytes=SMALL, keep_parts=100)
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        db.execute("CREATE TRIGGER full BEFORE DELETE ON journal BEGIN SELECT RAISE(ABORT, 'disk full'); END")
    filled(journal, range(200))
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        assert db.execute("SELECT COUNT(*) FROM journal").fetchone() == (200,)
        db.execute("DROP TRIGGER full")
    assert len(files_of(journal)) > 1
    filled(journal, range(200, 400))
    assert [record.data["i"] for record in journal.records()] == list(range(400))
    assert journal.verify() == 400
    journal.close()


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    (folder := tmp_path / "50%25 off? #1").mkdir()
    journal = Journal(folder / "j.sqlite")
    journal.append("tick", {})
    assert journal.verify() == len(journal.records()) == 1
    journal.close()


def test_a_closed_journal_refuses(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    journal.close()
    journal.close()
    with pytest.raises(JournalError):
        journal.append("late", {})
    journal.note("late", {})


def test_a_place_that_cannot_be_written_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="cannot be written"):
        Journal(tmp_path / "file" / "j.sqlite")


def test_a_failed_commit_reaches_its_caller_and_the_chain_goes_on(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    journal.append("good", {})
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        db.execute("CREATE TRIGGER full BEFORE INSERT ON journal BEGIN SELECT RAISE(ABORT, 'disk full'); END")
    journal.note("stop", {"why": "pressed while the disk was full"})
    with pytest.raises(JournalError, match="disk full"):
        journal.append("bad", {})
    with sqlite3.connect(tmp_path / "j.sqlite") as db:
        db.execute("DROP TRIGGER full")
    journal.append("good again", {})
    assert [record.kind for record in journal.records()] == ["good", "stop", "journal-failed", "good again"]
    assert journal.verify() == 4
    journal.close()


def test_a_killed_writer_loses_nothing_that_it_acknowledged(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from service.tasks.journal import Journal\n"
        f"j = Journal(Path({str(tmp_path / 'j.sqlite')!r}), part_bytes=20_000, keep_parts=1000)\n"
        "i = 0\n"
        "while True:\n"
        "    j.append('tick', {'i': i}); print(i, flush=True); i += 1\n"
    )
    for _ in range(3):
        writer = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert writer.stdout is not None
        acknowledged = [int(writer.stdout.readline()) for _ in range(20)][-1]
        os.kill(writer.pid, signal.SIGKILL)
        acknowledged = max([acknowledged, *(int(line) for line in writer.stdout if line.endswith("\n"))])
        writer.wait()
        writer.stdout.close()
        journal = Journal(tmp_path / "j.sqlite")
        assert journal.verify() == len(journal.records(limit=10**6))
        assert journal.records(limit=1)[-1].data["i"] >= acknowledged
        journal.close()
