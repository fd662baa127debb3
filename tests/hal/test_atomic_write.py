"""A file that is replaced is never incomplete."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.atomic_write import write_atomically


def test_what_was_there_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "panel.toml"
    assert write_atomically(path, "first\n") == path
    write_atomically(path, "zweite Tür\n")
    assert path.read_text(encoding="utf-8") == "zweite Tür\n"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "panel.toml"
    write_atomically(path, "whole\n")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(path, "half of it\n" * 10_000 + "\udcff")
    assert path.read_text(encoding="utf-8") == "whole\n"
    assert list(tmp_path.glob("*.toml")) == [path]


def test_a_folder_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="away"):
        write_atomically(tmp_path / "away" / "panel.toml", "text")
