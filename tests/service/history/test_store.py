"""Tests of the history: durable before it is reported, bounded, asked in pages and spans, and safe with odd files."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hal.errors import Unsupported
from hal.plant import HistorySection
from service.errors import HistoryError
from service.history.crops import Crops
from service.history.database import LOG_BYTES
from service.history.parts import read_parts
from service.history.reading import INVALID, VALID, StoredReading
from service.history.store import CHECKPOINT_EVERY_ADDS, DAY_S, History

NOW_S = 1_790_000_000.0


def reading(k: int, value: float | None = 1.0, **other: Any) -> StoredReading:
    is_valid = value is not None or "state" in other
    plain = {"object": "pressure", "kind": "gauge", "utc_s": NOW_S + k, "cell_s": float(k), "unit": "bar"}
    plain |= {"quality": VALID if is_valid else INVALID, "cause": "" if is_valid else "glare", "value": value}
    return StoredReading(**{**plain, **other})


def history_in(folder: Path, **bounds: Any) -> History:
    return History(folder, cell="bench", panel="bench", bounds=HistorySection(**bounds), now_s=lambda: NOW_S)


def test_readings_come_back_as_they_were_stored_page_by_page(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    readings = [reading(k, float(k), told="open", crop="ab" * 32, asked_by="alice", text=None) for k in range(7)]
    history.add(readings[:3])
    history.add(readings[3:])
    question, reader = history.ask(object="pressure"), history.reader()
    first = reader.page(question, limit=4)
    second = reader.page(question, after=first[-1].id, limit=4)
    assert [row.reading for row in (*first, *second)] == readings
    assert [row.reading for row in reader.last(question, limit=2)] == readings[-2:]
    assert [
        row.reading for row in reader.page(history.ask(object="pressure", since_s=NOW_S + 2, until_s=NOW_S + 3))
    ] == (readings[2:4])
    assert reader.page(history.ask(object="flow")) == []
    assert history.told() == {"pressure": "open"}
    other = History(tmp_path, cell="other", panel="bench")
    assert other.reader().page(other.ask(object="pressure")) == []
    assert [row.reading.object for row in other.reader().newest("bench")] == ["pressure"]


@given(
    sizes=st.lists(st.integers(0, 150), min_size=1, max_size=6),
    after=st.integers(0, 700),
    limit=st.integers(1, 300),
    answers=st.booleans(),
)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_newest_readings_are_those_of_the_file(
    tmp_path: Path, sizes: list[int], after: int, limit: int, answers: bool
) -> None:
    with tempfile.TemporaryDirectory(dir=tmp_path) as folder:
        mine, other = (History(Path(folder), cell=cell, panel="panel") for cell in ("mine", "other"))
        for size in sizes:
            mine.add([reading(k, float(k), doubt="which?") for k in range(size)])
            other.add([reading(k, 0.0) for k in range(size % 3)])
            if answers and size:
                first = mine.after(0, limit=1)[0]
                if first.reading.answered is None:
                    mine.answer(first.id, said="{}", value=1.5, state=None, text=None)
            assert mine.after(after, limit=limit) == mine.reader().page(mine.ask(), after=after, limit=limit)
        mine.close()
        other.close()


def test_a_trend_counts_refusals_and_leaves_them_out_of_the_values(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    history.add([reading(0, 1.0), reading(1, None), reading(2, 4.0), reading(9, 9.0), reading(10, 2.0)])
    first, last = history.reader().trend(history.ask(object="pressure"), buckets=2)
    assert (first.count, first.refused, first.minimum, first.maximum, first.mean) == (3, 1, 1.0, 4.0, 2.5)
    assert (last.count, last.refused, last.minimum, last.maximum, last.mean) == (2, 0, 2.0, 9.0, 5.5)
    assert (first.since_s, last.until_s) == (NOW_S, NOW_S + 10)


def test_a_trend_of_states_counts_each_state(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    history.add([reading(k, None, state=state) for k, state in enumerate(["open", "open", "closed"])])
    (only,) = history.reader().trend(history.ask(object="pressure"), buckets=1)
    assert (only.states, only.mean, only.count) == ({"open": 2, "closed": 1}, None, 3)
    assert history.reader().trend(history.ask(object="flow"), buckets=3) == []


def test_the_trend_of_buckets_agrees_with_plain_arithmetic(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    values = [(37 * k) % 101 / 10.0 for k in range(500)]
    history.add([reading(k, value) for k, value in enumerate(values)])
    found = history.reader().trend(history.ask(object="pressure", since_s=NOW_S, until_s=NOW_S + 499.0), buckets=10)
    for k, bucket in enumerate(found):
        inside = [v for i, v in enumerate(values) if min(int(i / 49.9), 9) == k]
        assert (bucket.count, bucket.minimum, bucket.maximum) == (len(inside), min(inside), max(inside))
        assert bucket.mean == pytest.approx(sum(inside) / len(inside))


def test_old_readings_are_deleted_and_young_ones_stay(tmp_path: Path) -> None:
    history = history_in(tmp_path, keep_days=10)
    history.add([reading(k, float(k), utc_s=NOW_S - (20 - k) * DAY_S) for k in range(20)])
    history.trim()
    kept = history.reader().page(history.ask())
    assert [row.reading.value for row in kept] == [float(k) for k in range(10, 20)]


def test_the_database_stays_within_its_size(tmp_path: Path) -> None:
    history = history_in(tmp_path, max_mb=1)
    for k in range(40):
        history.add([reading(100 * k + i, cause="x" * 500) for i in range(100)])
    history.trim()
    kept = history.reader().page(history.ask(), limit=4000)
    assert 500 < len(kept) < 2000
    assert kept[-1].reading.utc_s == NOW_S + 3999


@pytest.mark.parametrize("began_anew", [False, True])
def test_readings_that_leave_the_database_stay_in_parquet_and_are_read_as_one(tmp_path: Path, began_anew: bool) -> None:
    history = history_in(tmp_path, keep_days=10, parquet=True)
    odd = 'a "quoted", text\nof two lines and \\N'
    old = [reading(k, 1.0 + k, utc_s=NOW_S - 20 * DAY_S + k, cause=odd, state=None, text="") for k in range(5)]
    old.append(reading(5, None, utc_s=NOW_S - 20 * DAY_S + 5))
    history.add(old)
    history.trim()
    if began_anew:
        history.close()
        history.path.write_bytes(b"torn" * 1000)
        history = history_in(tmp_path, keep_days=10, parquet=True)
    new = [reading(k, 10.0 + k) for k in range(5)]
    history.add(new)
    reader, question = history.reader(), history.ask(object="pressure")
    assert [row.reading for row in reader.all(question)] == [*old, *new]
    assert [row.reading for row in reader.page(question, after=3, limit=5)] == [*old[3:], *new[:2]]
    assert [row.reading for row in reader.last(question, limit=7)] == [*old[-2:], *new]
    first, last = reader.trend(question, buckets=2)
    assert (first.count, first.refused, first.mean, last.mean) == (6, 1, 3.0, 12.0)
    (part,) = (tmp_path / "parts").iterdir()
    assert read_parts([part], "COUNT(*), SUM(value)", "", []) == [(6, 15.0)]
    assert sqlite3.connect(history.path).execute("SELECT COUNT(*) FROM readings").fetchone() == (5,)


def test_a_move_that_was_cut_off_after_the_part_was_written_doubles_nothing(tmp_path: Path) -> None:
    history = history_in(tmp_path, keep_days=10, parquet=True)
    history.add([reading(k, utc_s=NOW_S - 20 * DAY_S + k) for k in range(5)])
    shutil.copyfile(history.path, tmp_path / "copy.sqlite")
    shutil.copyfile(f"{history.path}-wal", tmp_path / "copy.sqlite-wal")
    history.trim()
    history.close()
    (tmp_path / "copy.sqlite").replace(history.path)
    (tmp_path / "copy.sqlite-wal").replace(f"{history.path}-wal")
    again = history_in(tmp_path, parquet=True)
    assert len(again.reader().page(again.ask())) == 5


def test_parquet_without_duckdb_is_refused_at_the_start_and_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.history.parts.find_spec", lambda _name: None)
    with pytest.raises(Unsupported, match="DuckDB") as caught:
        history_in(tmp_path, parquet=True)
    assert "panelwright[history]" in caught.value.hint


def test_a_history_of_a_newer_version_is_refused_and_not_changed(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    history.add([reading(0)])
    history.close()
    with sqlite3.connect(history.path) as db:
        db.execute("PRAGMA user_version=3")
    db.close()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    with pytest.raises(HistoryError, match="newer panelwright") as caught:
        history_in(tmp_path)
    assert "has not been changed" in caught.value.hint
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("damage", ["no database", "torn in the middle", "empty pages"])
def test_a_damaged_history_is_set_aside_and_a_new_one_begun(tmp_path: Path, damage: str) -> None:
    history = history_in(tmp_path)
    history.add([reading(k, cause="x" * 300) for k in range(200)])
    history.close()
    whole = history.path.read_bytes()
    torn = {"no database": b"hello" * 100, "torn in the middle": whole[: len(whole) // 2 + 100]}
    history.path.write_bytes(torn.get(damage, whole[:8192] + bytes(8192) + whole[16384:]))
    damaged = history.path.read_bytes()
    again = history_in(tmp_path)
    again.add([reading(1)])
    assert len(again.reader().page(again.ask())) == 1
    (aside,) = again.set_aside
    assert again.set_aside_now == aside
    assert aside.read_bytes() == damaged


def test_a_history_that_cannot_be_written_says_so_and_recovers(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    history.add([reading(0)])
    history._db.execute("PRAGMA max_page_count=1")  # what a full disk is to SQLite
    with pytest.raises(HistoryError, match="full"):
        history.add([reading(k, cause="x" * 4000) for k in range(50)])
    history._db.execute("PRAGMA max_page_count=1000000")
    history.add([reading(2)])
    assert [row.reading.utc_s - NOW_S for row in history.reader().page(history.ask())] == [0.0, 2.0]


def test_the_log_is_moved_into_the_database_while_readings_are_stored(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    for k in range(2 * CHECKPOINT_EVERY_ADDS):
        history.add([reading(k)])
    history._thread.submit(lambda: None).result()  # the checkpoints before it are done
    alone = shutil.copy(history.path, tmp_path / "without-log.sqlite")
    with closing(sqlite3.connect(alone)) as db:
        moved = db.execute("SELECT COUNT(*) FROM readings").fetchone()[0]
    assert moved >= CHECKPOINT_EVERY_ADDS
    history.close()


def test_the_log_has_its_space_before_the_first_reading_and_keeps_it(tmp_path: Path) -> None:
    sizes, history = [], history_in(tmp_path)
    log = history.path.with_name(f"{history.path.name}-wal")
    for k in range(2 * CHECKPOINT_EVERY_ADDS):
        sizes.append(log.stat().st_size)
        history.add([reading(k)])
        if k % CHECKPOINT_EVERY_ADDS == CHECKPOINT_EVERY_ADDS - 1:
            history._thread.submit(lambda: None).result()  # the checkpoint before it is done
    assert set(sizes) == {LOG_BYTES}
    history.close()
    again = history_in(tmp_path)
    assert len(again.reader().page(again.ask())) == len(sizes)
    again.close()


def test_no_stored_reading_is_lost_by_kill_9(tmp_path: Path) -> None:
    code = f"""
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from tests.service.history.test_store import history_in, reading
history = history_in(Path({str(tmp_path)!r}))
for k in range(10_000):
    history.add([reading(k)])
    print(k, flush=True)
"""
    root = Path(__file__).parents[3]
    with subprocess.Popen([sys.executable, "-c", code], cwd=root, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        told = [int(writer.stdout.readline()) for _ in range(20)]
        writer.send_signal(signal.SIGKILL)
        told += [int(line) for line in writer.stdout if line.endswith("\n")]
    history = history_in(tmp_path)
    stored = [row.reading.utc_s - NOW_S for row in history.reader().all(history.ask())]
    assert stored == [float(k) for k in range(len(stored))]
    assert told[-1] < len(stored)


def test_pictures_are_stored_once_and_the_oldest_go_first(tmp_path: Path) -> None:
    crops = Crops(tmp_path / "crops", max_bytes=2500)
    names = [crops.add(bytes([k]) * 1000) for k in range(3)]
    assert crops.add(bytes([2]) * 1000) == names[2]
    assert len(list((tmp_path / "crops").glob("*/*.png"))) == 3
    import os

    for k, name in enumerate(names):
        os.utime(crops.path(str(name)) or tmp_path, (NOW_S + k, NOW_S + k))
    crops.shrink()
    assert [crops.path(str(name)) is not None for name in names] == [False, True, True]
    assert crops.path("../../history.sqlite") is None
    assert Crops(tmp_path / "none", max_bytes=0).add(b"x") is None
