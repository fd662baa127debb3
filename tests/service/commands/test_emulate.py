"""Tests of `panelwright emulate`: which cell and device a name refers to, and what is printed for a driver."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from hal.errors import ConfigError
from service.commands.develop import find_emulator, inline_toml

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(("name", "device"), [("ur", "arm"), ("arm", "arm"), ("netft", "wrist_ft")])
def test_an_emulator_is_found_by_its_name_or_its_devices(name: str, device: str) -> None:
    cells = [ROOT / "cells/mixed.toml", ROOT / "cells/wire-ur.toml"]
    cell, found = find_emulator(name, cells)
    assert (cell.path, found) == (cells[1], device)


def test_a_wire_that_nobody_emulates_is_named_with_those_that_are() -> None:
    with pytest.raises(ConfigError, match="nothing emulates 'kuka'") as caught:
        find_emulator("kuka", [ROOT / "cells/wire-ur.toml"])
    assert "arm (ur)" in caught.value.hint


def test_the_options_of_an_emulated_wire_are_pasted_into_a_cell_file() -> None:
    options = {
        "host": "127.0.0.1",
        "port": 4000,
        "nodes": [1, 2],
        "kinematics": {"model": "ur10e", "lower_rad": (-6.28, 1.0)},
    }
    assert tomllib.loads(f"options = {inline_toml(options)}")["options"] == {
        **options, "kinematics": {"model": "ur10e", "lower_rad": [-6.28, 1.0]},
    }  # fmt: skip
