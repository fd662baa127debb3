"""Tests of what the files of an earlier mission tell."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from service.missions.earlier import Told, told_of


def leave(folder: Path, *, done: list[str]) -> None:
    readings = {"readings": [{"name": "pressure"}, {"name": "flow"}], "actions": [{"object": "valve"}]}
    report = {"started": "2026-01-03T00:00:00Z", "succeeded": False, **readings}
    (folder / "report.json").write_text(json.dumps(report))
    steps = [{"name": "read"}, {"name": "feel"}, {"name": "operate"}]
    (folder / "progress.json").write_text(json.dumps({"mission": {"title": "Look", "steps": steps}, "done": done}))
    os.utime(folder / "progress.json", ns=(len(done), len(done)))


def test_the_first_unfinished_step_is_told_until_nothing_is_left(tmp_path: Path) -> None:
    leave(tmp_path, done=["read", "feel#1/touch"])
    told = told_of(tmp_path)
    assert (told.title, told.succeeded, told.unfinished_step) == ("Look", False, "feel")
    assert told.objects == ("flow", "pressure", "valve")
    leave(tmp_path, done=["read", "feel", "operate"])
    assert told_of(tmp_path).unfinished_step is None


@pytest.mark.parametrize("damaged", ["", "[]", '{"mission": 3, "done": 4, "readings": 5, "actions": [6]}'])
def test_damaged_files_tell_nothing(tmp_path: Path, damaged: str) -> None:
    for name in ("report.json", "progress.json"):
        (tmp_path / name).write_text(damaged)
    assert told_of(tmp_path) == Told()
