"""The ports and hosts that options name are found wherever they stand in them."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.config import load_cell
from hal.errors import InvalidRequest
from service.commissioning.places import AllowedPlaces, places_of
from tests.service.conftest import WriteCell


def test_places_are_found_in_tables_and_lists_and_names_are_not_places() -> None:
    options = {"host": "10.0.0.4", "port": 502, "topic": "/joint_states", "model": "a/b", "baud": 9600}
    assert places_of(options) == {"10.0.0.4:502"}
    assert places_of({"host": "10.0.0.4"}) == {"10.0.0.4"}
    assert places_of({"lines": [{"port": "/dev//ttyS0"}, {"channel": 3}]}) == {"/dev/ttyS0", "3"}
    assert places_of({"of_any_name": "/etc/passwd"}) == {"/etc/passwd"}


def test_the_cell_file_allows_its_own_places_and_those_that_it_lists(write_cell: WriteCell, tmp_path: Path) -> None:
    path = write_cell(mode="real", extra='[safety]\nallowed_places = ["10.0.0.40", "/dev/serial/by-id/*"]')
    text = path.read_text().replace(
        '"fake:lights"\noptions = {  }', '"modbus:lights"\noptions = { host = "10.0.0.30" }'
    )
    path.write_text(text)
    allowed = AllowedPlaces.of(load_cell(path), tmp_path / "recordings")
    for options in (
        {"host": "10.0.0.30"},
        {"host": "10.0.0.40", "port": 49152},
        {"port": "/dev/serial/by-id/usb-1"},
        {"replay": str((tmp_path / "recordings").resolve() / "a.bin")},
        {},
    ):
        allowed.check("x", options)
    for wrong in ({"host": "10.0.0.30", "port": 22}, {"port": "/dev/serial/by-id/../../mem"}, {"host": "10.0.0.41"}):
        with pytest.raises(InvalidRequest, match="none of the ports"):
            allowed.check("x", wrong)
