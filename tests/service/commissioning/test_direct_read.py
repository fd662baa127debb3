"""Tests of reading one device of a cell file without a service: `panelwright devices read NAME --cell CELL`."""

import json
from pathlib import Path

import pytest

from drivers.emulators import tfmini
from drivers.emulators.scripted import ScriptedProximity
from hal.config import Cell, load_cell
from hal.errors import ConfigError
from service.commissioning.direct_read import as_line, read_lines

ROOT = Path(__file__).parents[3]


def cell_with(port: str) -> Cell:
    """Return the shipped mixed cell as a real one whose left finger sensor is on `port`."""
    cell = load_cell(ROOT / "cells" / "mixed.toml")
    devices = dict(cell.file.devices)
    section = devices["proximity_left"]
    devices["proximity_left"] = section.model_copy(update={"options": {**section.options, "port": port}})
    real = cell.file.cell.model_copy(update={"mode": "real"})
    return cell.model_copy(
        update={"file": cell.file.model_copy(update={"cell": real, "devices": devices, "emulators": {}})}
    )


def test_each_line_is_a_new_sample_with_stamps_age_and_quality() -> None:
    far_side = tfmini.start(ScriptedProximity(), {})
    try:
        lines = list(read_lines(cell_with(far_side.address["port"]), "proximity_left", samples=5, timeout_s=1.0))
    finally:
        far_side.close()
    assert len({line["sequence"] for line in lines}) == 5
    for line in map(json.loads, map(as_line, lines)):
        assert line["quality"] == "valid" and line["device_time_s"] is None
        assert 0.0 <= line["age_s"] < 1.0 and line["took_s"] >= 0.0
        assert abs((line["value"] - 0.1) / 0.001 % 1.0 - 0.5) > 0.49


def test_a_silent_call_is_a_line_with_the_error_and_its_remedy() -> None:
    far_side = tfmini.start(ScriptedProximity(), {"fault": "silent", "every": 3, "silent_s": 0.4})
    try:
        lines = list(read_lines(cell_with(far_side.address["port"]), "proximity_left", samples=4, timeout_s=0.1))
    finally:
        far_side.close()
    errors = [line["error"] for line in lines if "error" in line]
    assert len(lines) == 4 and errors
    assert all("proximity_left" in error["what"] and error["hint"] for error in errors)


def test_a_missing_port_gives_errors_and_ends() -> None:
    lines = list(read_lines(cell_with("/dev/serial/by-id/nothing"), "proximity_left", samples=50, timeout_s=0.1))
    assert [line["error"]["type"] for line in lines] == ["device-unavailable"] * 3


def test_an_unknown_device_is_answered_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="has no device 'left'") as caught:
        list(read_lines(cell_with("x"), "left", samples=1, timeout_s=0.1))
    assert "proximity_left" in caught.value.hint
