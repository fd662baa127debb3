"""The doctor finds missing, taken and forbidden ports, wrong baud rates, and measures what answers."""

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators import lms200, tfmini
from drivers.emulators.ports import PtyPort
from drivers.emulators.scripted import ScriptedProximity, ScriptedScanner
from drivers.transport.serial_link import latency_timer_ms
from drivers.wire_doctor import examine_device, examine_port, measured, serial_path
from hal.errors import DeviceTimeout, DeviceUnavailable
from hal.registry import Context, connect


def test_a_port_that_is_not_there_a_taken_one_and_a_free_one() -> None:
    assert "does not exist" in examine_port("/dev/serial/by-id/nothing").what
    with closing(PtyPort("line")) as port:
        path = str(port.path)
        own = examine_port(path)  # the emulator's own end counts as an owner
        assert not own.is_good and f"pid {os.getpid()}" in own.what
        assert latency_timer_ms(path) is None


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_port_without_permission(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    path.touch(mode=0)
    found = examine_port(str(path))
    assert not found.is_good and "dialout" in found.hint


def test_a_free_port_is_good(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    path.touch()
    assert examine_port(str(path)).is_good


@pytest.mark.parametrize(
    ("options", "path"),
    [
        ({"port": "/dev/x"}, "/dev/x"),
        ({"channel": "/dev/c"}, "/dev/c"),
        ({"port": 502}, None),
        ({"channel": "can0"}, None),
    ],
)
def test_devices_with_a_serial_wire_are_told_by_their_options(options: dict[str, Any], path: str | None) -> None:
    assert serial_path(options) == path


class Answers:
    """A device that is there."""

    def close(self) -> None:
        """Nothing."""


def test_the_baud_rate_that_answers_is_named(tmp_path: Path) -> None:
    tried: list[int] = []

    def open_device(name: str, driver: str, options: dict[str, Any]) -> Any:
        tried.append(options["baud"])
        if options["baud"] != 57_600:
            raise DeviceUnavailable(f"{name} gives no valid data", hint="baud?")
        return Answers()

    path = tmp_path / "tty"
    path.touch()
    (found,) = examine_device("finger", "x:y", {"baud": 115_200}, str(path), open_device=open_device)
    assert not found.is_good and "57600" in found.what and "57600" in found.hint
    assert tried[0] == 115_200 and tried.count(115_200) == 1


def test_a_device_that_never_answers_keeps_its_own_words(tmp_path: Path) -> None:
    def open_device(name: str, driver: str, options: dict[str, Any]) -> Any:
        raise DeviceTimeout(f"{name} is silent", hint="power?")

    path = tmp_path / "tty"
    path.touch()
    (found,) = examine_device("finger", "x:y", {}, str(path), open_device=open_device)
    assert (found.what, found.hint) == ("finger is silent", "power?")


@pytest.mark.parametrize(
    ("start", "backing", "driver"),
    [(tfmini.start, ScriptedProximity, "serial:tfmini"), (lms200.start, ScriptedScanner, "serial:lms200")],
)
def test_what_answers_is_measured(start: Any, backing: Any, driver: str) -> None:
    far_side = start(backing(), {})
    try:
        with closing(connect(Context(name="dut"), driver, far_side.address)) as device:
            assert "samples/s" in measured(device)
    finally:
        far_side.close()
