"""A copied cell is complete, loads by itself, and never overwrites anything."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.config import load_cell
from hal.errors import ConfigError
from service.commissioning.new_cell import copy_cell
from service.terminal import ROOT

SHIPPED = sorted((ROOT / "cells").glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_copy_says_the_same_and_needs_nothing_outside_of_its_folder(path: Path, tmp_path: Path) -> None:
    copied = copy_cell(path, tmp_path / "mine")
    original, copy = load_cell(path), load_cell(copied.cell)
    assert copy.file == original.file
    assert copy.panel == original.panel
    assert copy.calibrations == original.calibrations
    named = [copy.panel_path, *(copy.calibration_path(name) for name in copy.calibrations)]
    if copy.knowledge_path is not None:
        named += copy.knowledge_path.iterdir()
    assert all(file.is_relative_to(tmp_path / "mine") for file in named)
    assert {file.resolve() for file in (copied.cell, *named)} == {file.resolve() for file in copied.files}


def test_nothing_is_written_when_one_file_is_there_already(tmp_path: Path) -> None:
    panel = tmp_path / "panels" / "bench.toml"
    panel.parent.mkdir()
    panel.write_text("mine")
    with pytest.raises(ConfigError, match="exists already") as refused:
        copy_cell(Path("cells/bench.toml"), tmp_path)
    assert str(panel) in refused.value.what
    assert panel.read_text() == "mine"
    assert not (tmp_path / "cells").exists()


def test_a_cell_that_names_a_file_by_an_absolute_path_is_not_copied(tmp_path: Path) -> None:
    text = (ROOT / "cells" / "bench.toml").read_text()
    for folder in ("calibrations", "knowledge"):
        text = text.replace(f'"cells/{folder}', f'"{ROOT}/cells/{folder}')
    path = tmp_path / "absolute.toml"
    path.write_text(text.replace('"panels/bench.toml"', f'"{ROOT}/panels/bench.toml"'))
    with pytest.raises(ConfigError, match=r"cell\.panel: .* outside of its folder"):
        copy_cell(path, tmp_path / "mine")
    assert not (tmp_path / "mine").exists()
