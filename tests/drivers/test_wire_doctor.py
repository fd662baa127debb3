"""The doctor finds missing, busy and forbidden ports and wrong baud rates, and measures devices that answer."""

import os
import termios
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators import lms200, tfmini
from drivers.emulators.ports import PtyPort
from drivers.emulators.scripted import ScriptedProximity, ScriptedScanner
from drivers.transport.can_adapters import find_adapters, plain, read_findings
from drivers.transport.serial_link import latency_timer_ms, port_owner, shorten_latency_timer
from drivers.wire_doctor import WireFinding, can_adapters, examine_device, examine_port, measured, serial_path
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
        ({"channel": "tcp://host:4000"}, None),
    ],
)
def test_devices_with_a_serial_wire_are_told_by_their_options(options: dict[str, Any], path: str | None) -> None:
    assert serial_path(options) == path


def test_can_adapters_are_listed_with_the_options_that_select_them() -> None:
    told = b'{"interface": "pcan", "channel": "PCAN_USBBUS1", "fd": true}\n{"interface": "soc'
    (found,) = can_adapters(uses_can=True, search=lambda: read_findings(told))
    assert (found.subject, found.is_good) == ("CAN pcan PCAN_USBBUS1", True)
    assert found.what == 'found: interface = "pcan", channel = "PCAN_USBBUS1", fd = true'
    assert plain({"channel": 0, "config": object()}) == {"channel": 0}


def test_that_there_is_no_can_adapter_is_said_where_the_cell_needs_one() -> None:
    assert [f.subject for f in can_adapters(uses_can=True, search=list)] == ["CAN adapters"]
    assert list(can_adapters(uses_can=False, search=list)) == []


def test_the_search_for_adapters_prints_nothing_and_ends(capfd: pytest.CaptureFixture[str]) -> None:
    assert isinstance(find_adapters(), list)
    assert find_adapters(within_s=0.001) == []
    assert capfd.readouterr() == ("", "")


class Answers:
    """Device that is present."""

    def close(self) -> None:
        """Do nothing."""


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


def test_a_serial_device_with_a_wrong_option_is_one_finding_among_the_others(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    path.touch()
    (found,) = examine_device("finger", "serial:tfmini", {"port": str(path), "buad": 1}, str(path))
    assert not found.is_good and "buad" in found.what


class NoisyAtOtherBauds(PtyPort):
    """Port on which a wrong baud rate gives noise."""

    def send(self, peer: Any, data: bytes) -> None:
        """Send the frame, or the noise that a receiver at another baud rate gets."""
        super().send(peer, data if self.speed() == termios.B115200 else bytes(b ^ 0xE6 for b in data[::2]))


def test_a_driver_at_the_wrong_baud_rate_is_told_the_one_that_answers() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tfmini, "PtyPort", NoisyAtOtherBauds)
        far_side = tfmini.start(ScriptedProximity(), {})
    path = str(far_side.port.path)
    options, free = {"port": path, "baud": 9600}, WireFinding(path, True, "free")
    with closing(far_side):
        found = list(examine_device("finger", "serial:tfmini", options, path, look_at=lambda _: free))
    assert [(f.is_good, f.what) for f in found] == [(False, "wrong baud rate: it answers at 115200")]
    assert found[0].hint == "set `baud = 115200` in its options"


@pytest.fixture
def adapter(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Create a USB adapter as the kernel presents it: stable name, sysfs tree, latency timer."""
    device = tmp_path / "ttyUSB7"
    device.touch()
    stable = tmp_path / "usb-acme-if00"
    stable.symlink_to(device)
    timer = tmp_path / "sys" / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    return stable, tmp_path / "sys", timer


def test_the_latency_timer_is_found_behind_the_stable_name_and_shortened(adapter: tuple[Path, Path, Path]) -> None:
    stable, sysfs, timer = adapter
    assert latency_timer_ms(str(stable), sysfs=sysfs) == 16
    found = examine_port(str(stable), sysfs=sysfs)
    assert found.is_good and found.what == "free; latency timer 16 ms" and "udev" in found.hint
    assert shorten_latency_timer(str(stable), sysfs=sysfs) == 1
    assert timer.read_text() == "1\n"
    assert examine_port(str(stable), sysfs=sysfs).hint == ""


def test_a_timer_that_may_not_be_set_is_reported_as_it_is(
    adapter: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    stable, sysfs, timer = adapter

    def refuse(*_: object) -> int:
        raise PermissionError(13, "not yours")

    monkeypatch.setattr(Path, "write_text", refuse)
    assert shorten_latency_timer(str(stable), sysfs=sysfs) == 16
    assert timer.read_text() == "16\n"


@pytest.mark.parametrize("text", ["", "fast\n"])
def test_a_timer_that_says_nothing_is_none(text: str, adapter: tuple[Path, Path, Path]) -> None:
    stable, sysfs, timer = adapter
    timer.write_text(text)
    assert shorten_latency_timer(str(stable), sysfs=sysfs) is None
    assert "no latency timer" in examine_port(str(stable), sysfs=sysfs).what


def test_a_port_whose_name_vanishes_while_it_is_looked_at_has_no_timer_and_no_owner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def vanished(path: str) -> str:
        raise FileNotFoundError(2, "gone", path)

    monkeypatch.setattr(os.path, "realpath", vanished)
    assert shorten_latency_timer("/dev/x") is None
    assert port_owner("/dev/x") is None


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
