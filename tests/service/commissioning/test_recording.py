"""Tests of recording and replaying the link of a device, and of watching the devices of a running service."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from drivers.emulators import tfmini
from drivers.emulators.scripted import ScriptedProximity
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import ConfigError, DeviceUnavailable
from service.commands.devices import app
from service.commissioning.recording import record, replay
from service.commissioning.watching import Watch, brief
from service.serve import Panelwright
from tests.service.conftest import WriteCell

WIRED = """
[devices.left]
kind = "proximity"
driver = "serial:tfmini"
options = { port = "PORT" }
"""


@pytest.fixture
def wired_cell(write_cell: WriteCell) -> Any:
    """Yield a cell file with one device on a link."""
    far_side = tfmini.start(ScriptedProximity(), {})
    yield write_cell(mode="real", extra=WIRED.replace("PORT", far_side.address["port"]))
    far_side.close()


def values(items: list[dict[str, Any]]) -> dict[int, Any]:
    return {item["sequence"]: item["value"] for item in items if "error" not in item}


def test_a_recording_is_read_to_the_same_samples_without_the_device(wired_cell: Path, tmp_path: Path) -> None:
    path = tmp_path / "left.jsonl"
    recorded = values(list(record(load_cell(wired_cell), "left", path, duration_s=1.0, timeout_s=1.0)))
    replayed = values(list(replay(path, timeout_s=1.0)))
    both = recorded.keys() & replayed.keys()
    assert len(both) > 30
    assert all(recorded[number] == replayed[number] for number in both)


def test_the_commands_say_what_they_did(wired_cell: Path, tmp_path: Path) -> None:
    path, runner = tmp_path / "left.jsonl", CliRunner()
    done = runner.invoke(app, ["record", "left", str(path), "--cell", str(wired_cell), "--seconds", "0.3"])
    assert done.exit_code == 0, done.output
    assert f"panelwright devices replay {path}" in done.stderr
    done = runner.invoke(app, ["replay", str(path), "--jsonl"])
    assert done.exit_code == 0, done.output
    assert all(json.loads(line)["device"] == "left" for line in done.stdout.splitlines())
    assert "samples in" in done.stderr


def test_a_device_without_a_wire_and_a_file_that_exists_are_refused(wired_cell: Path, tmp_path: Path) -> None:
    cell, path = load_cell(wired_cell), tmp_path / "x.jsonl"
    with pytest.raises(ConfigError, match=r"panel_lights: fake:lights has no wire") as caught:
        list(record(cell, "panel_lights", path, duration_s=0.1, timeout_s=0.1))
    assert "devices read panel_lights" in caught.value.hint
    assert not path.exists()
    path.write_text("mine\n")
    with pytest.raises(ConfigError, match="exists already"):
        list(record(cell, "left", path, duration_s=0.1, timeout_s=0.1))
    assert path.read_text() == "mine\n"


def test_a_device_that_does_not_connect_leaves_the_name_of_the_recording_free(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    cell, path = load_cell(write_cell(mode="real", extra=WIRED.replace("PORT", "/dev/none"))), tmp_path / "x.jsonl"
    for _ in range(2):
        with pytest.raises(DeviceUnavailable):
            list(record(cell, "left", path, duration_s=0.1, timeout_s=0.1))
    assert not path.exists()


def test_a_recording_into_a_folder_that_is_not_there_is_refused(wired_cell: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        list(record(load_cell(wired_cell), "left", tmp_path / "none" / "x.jsonl", duration_s=0.1, timeout_s=0.1))


@pytest.mark.parametrize(
    "text", ["", "nonsense\n", "{}\n", '{"device": "a", "kind": "b", "driver": "c", "options": {}}\n']
)
def test_a_file_that_is_no_recording_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"x\.jsonl") as caught:
        list(replay(path, timeout_s=0.1))
    assert "panelwright devices record" in caught.value.hint


class FakeService:
    """Answers like the service, for one device after the other."""

    def __init__(self) -> None:
        self.samples, self.errors, self.asked = 100, 3, list[str]()
        self.reading: dict[str, Any] | Exception = {
            "quality": "valid",
            "cause": "none",
            "age_s": 0.012,
            "value": 0.12345,
        }
        self.kind = "proximity"

    def get(self, path: str) -> Any:
        self.asked.append(path)
        if path == "/v1/devices":
            health = {"connected": True, "quality": "valid", "cause": "none", "detail": "serial x", "reconnects": 2}
            health |= {"samples": self.samples, "errors": self.errors}
            view = {"name": "left", "kind": self.kind, "driver": "serial:tfmini", "health": health}
            return {"devices": [{**view, "reading_url": "/v1/devices/left/reading"}]}
        if isinstance(self.reading, Exception):
            raise self.reading
        return self.reading


def test_a_row_has_value_age_rate_and_the_errors_since_the_last_look() -> None:
    service, moments = FakeService(), iter([10.0, 12.0])
    watch = Watch(service, now_s=lambda: next(moments))
    (first,) = watch.look()
    assert (first.value, first.age_s, first.rate_hz, first.errors_since) == ("0.1235 m", 0.012, None, 0)
    service.samples, service.errors = 300, 4
    (second,) = watch.look()
    assert (second.rate_hz, second.errors, second.errors_since, second.reconnects) == (100.0, 4, 1, 2)


def test_a_device_that_was_opened_anew_has_no_rate_yet() -> None:
    service, moments = FakeService(), iter([10.0, 12.0, 13.0])
    watch = Watch(service, now_s=lambda: next(moments))
    watch.look()
    service.samples, service.errors = 20, 0
    (anew,) = watch.look()
    assert (anew.rate_hz, anew.errors_since) == (None, 0)
    service.samples = 120
    assert watch.look()[0].rate_hz == 100.0


def test_what_went_wrong_stands_in_the_place_of_the_value() -> None:
    service = FakeService()
    service.reading = DeviceUnavailable("left is disconnected", hint="plug it in")
    assert Watch(service).look()[0].value == "left is disconnected"
    service.reading = {"quality": "invalid", "cause": "saturated", "age_s": 0.1, "value": None}
    assert Watch(service).look()[0].value == "invalid (saturated)"


def test_pictures_are_read_only_when_they_are_wanted() -> None:
    service = FakeService()
    service.kind = "camera"
    service.reading = {"quality": "valid", "cause": "none", "age_s": 0.1, "value": {"mean_level": 93.04}}
    assert Watch(service).look()[0].value == ""
    assert service.asked == ["/v1/devices"]
    assert Watch(service, with_pictures=True).look()[0].value == "93.0 mean level"


@pytest.mark.parametrize(
    ("kind", "value", "shown"),
    [
        (DeviceKind.ARM, {"position_rad": [0.0, -1.2]}, "0.000 -1.200 rad"),
        (DeviceKind.TOUCH, [True, False], "on off"),
        (DeviceKind.FORCE_TORQUE, {"force_n": [1.0, 2.0, None]}, "1.00 2.00 - N"),
        (DeviceKind.PROXIMITY, None, "- m"),
    ],
)
def test_values_are_shown_in_few_characters(kind: DeviceKind, value: Any, shown: str) -> None:
    assert brief(kind, value) == shown


def test_a_running_service_is_watched(served: Panelwright) -> None:
    done = CliRunner().invoke(app, ["watch", "--url", served.url, "--count", "2", "--period-s", "0.1", "--pictures"])
    assert done.exit_code == 0, done.output
    rows = {row.name: row for row in Watch(_client(served), with_pictures=True).look()}
    assert rows.keys() == served.service.cell.file.devices.keys()
    assert all(row.value and row.health == "valid" and row.age_s is not None for row in rows.values()), rows


def _client(served: Panelwright) -> Any:
    from service.client import Client

    return Client(url=served.url)
