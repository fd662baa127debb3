"""A batch writes each result at once, and a second run reuses exactly the results that are still valid."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from hal.errors import InvalidRequest
from perception.range.batch import batch_range
from perception.range.batch_results import BatchResult, KeptResults
from perception.range.recordings import AS_FILED, Reading

SCENE = {"surfaces": []}
GOOD = [BatchResult(name=f"scan_{k}.npy", scene=SCENE, error=None) for k in range(4)]
BAD = BatchResult(name="scan_4.npy", scene=None, error="InvalidRequest: no recording")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scans").mkdir()
    for result in (*GOOD, BAD):
        (tmp_path / "scans" / result.name).write_bytes(b"numbers")
    return tmp_path / "scans"


def kept_in(folder: Path, reading: Reading = AS_FILED, *, afresh: bool = False) -> KeptResults:
    return KeptResults(folder.parent / "all.jsonl", folder, reading, afresh=afresh)


def stopped_batch(folder: Path) -> KeptResults:
    """Return a batch that was stopped after its second task."""
    kept = kept_in(folder)
    assert kept.of(folder.iterdir()) == {} and not kept.goes_on
    kept.add(GOOD[:2])
    kept.add([GOOD[2], BAD])
    assert kept.done == 4
    return kept


def test_a_second_run_takes_over_what_gave_a_scene(folder: Path) -> None:
    stopped_batch(folder)
    again = kept_in(folder)
    assert again.goes_on
    assert again.of(folder.iterdir()) == {result.name: result for result in GOOD[:3]}
    assert again.done == 3


def test_a_recording_that_has_changed_is_analysed_again(folder: Path) -> None:
    stopped_batch(folder)
    os.utime(folder / "scan_1.npy", ns=(1, 1))
    assert set(kept_in(folder).of(folder.iterdir())) == {"scan_0.npy", "scan_2.npy"}


def test_a_line_that_an_abrupt_end_has_cut_costs_only_itself(folder: Path) -> None:
    part = stopped_batch(folder).part
    whole = part.read_text()
    part.write_text(whole[: whole.index("scan_2.npy") + 12])
    again = kept_in(folder)
    assert set(again.of(folder.iterdir())) == {"scan_0.npy", "scan_1.npy"}
    again.add(GOOD[2:])
    assert set(kept_in(folder).of(folder.iterdir())) == {result.name for result in GOOD}


def test_what_is_told_as_done_is_what_is_written(folder: Path) -> None:
    """Ctrl-C may come between a write and its count."""
    kept = stopped_batch(folder)
    lines = kept.part.read_text().splitlines(keepends=True)
    kept.part.write_text("".join(lines[:-1]))
    assert kept.done == 3


def test_results_of_another_batch_are_neither_mixed_in_nor_lost(folder: Path) -> None:
    part = stopped_batch(folder).part
    before = part.read_text()
    with pytest.raises(InvalidRequest, match="other options") as refused:
        kept_in(folder, Reading(scale_m=0.001))
    assert "--afresh" in refused.value.hint and part.read_text() == before
    assert kept_in(folder, Reading(scale_m=0.001), afresh=True).of(folder.iterdir()) == {}


def test_the_whole_file_appears_at_the_end_in_order(folder: Path) -> None:
    kept = stopped_batch(folder)
    out = folder.parent / "all.jsonl"
    assert not out.exists()
    kept.finish([*GOOD, BAD])
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [line["name"] for line in lines] == [result.name for result in (*GOOD, BAD)]
    assert lines[0] == {"name": "scan_0.npy", "scene": SCENE, "error": None}
    assert not kept.part.exists()


def test_a_batch_that_was_done_needs_no_workers(folder: Path) -> None:
    (folder / BAD.name).unlink()
    kept = kept_in(folder)
    kept.of(folder.iterdir())
    kept.add(GOOD)
    seen: list[tuple[int, int]] = []
    results = batch_range(folder, scheduler="nowhere", kept=kept_in(folder), progress=lambda *count: seen.append(count))
    assert results == GOOD and seen == [(4, 4)]
