"""The examples of real cells are whole: every option is one that its driver takes, and no two devices claim one wire."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.config import load_cell
from hal.registry import device_factory, kinds_of, options_model
from hal.strict import faults_in
from service.commissioning.cell_check import check_cell
from service.commissioning.preflight import check_wires

CELLS = sorted((Path(__file__).parents[2] / "cells").glob("real-*.toml"))


@pytest.mark.parametrize("path", CELLS, ids=lambda path: path.stem)
def test_a_real_cell_needs_nothing_but_its_own_addresses(path: Path) -> None:
    cell = load_cell(path)
    assert cell.file.cell.mode == "real"
    assert not cell.file.emulators
    for section in cell.file.devices.values():
        factory = device_factory(section.driver)
        model, kinds = options_model(factory), kinds_of(factory)
        assert model is not None and faults_in(section.options, model) == []  # a driver without a model checks nothing
        assert kinds is not None and section.kind in kinds
    check_cell(cell)
    check_wires(cell)
