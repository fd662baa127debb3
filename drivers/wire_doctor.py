"""Diagnosis of links: ports, adapters, permissions, owners, latency timers, working baud rate, measured latency.

`panelwright doctor` finds this by the entry point `panelwright.doctor`.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.transport.can_adapters import find_adapters
from drivers.transport.device import WireDevice
from drivers.transport.serial_link import SYSFS, latency_timer_ms, port_owner, serial_ports
from hal.clock import Deadline, WallClock
from hal.config import Cell
from hal.errors import CellError, DeviceUnavailable
from hal.registry import Context, connect

BAUDS = (
    115_200,
    57_600,
    1_000_000,
    19_200,
    9_600,
    38_400,
    460_800,
    921_600,
    230_400,
)  # each attempt takes seconds, so the usual rates come first
SAMPLES = 30
SLOW_TIMER_MS = 2
TIMER_HINT = (
    "the drivers shorten it when they open the port, if they have permission; a udev rule makes this permanent: "
    'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{latency_timer}="1"'
)
Connect = Callable[[str, str, dict[str, Any]], Any]


@dataclass(frozen=True, slots=True)
class WireFinding:
    """One line of the doctor's report; `hint` states the remedy if the finding is not good."""

    subject: str
    is_good: bool
    what: str
    hint: str = ""


def examine(cell: Cell) -> Iterator[WireFinding]:
    """Examine every serial port and CAN adapter of this machine, then every device of the cell that has its own link."""
    for path in serial_ports():
        yield examine_port(path)
    wired = [one.driver for name, one in cell.file.devices.items() if name not in cell.file.emulators]
    yield from can_adapters(uses_can=any(driver.startswith("can:") for driver in wired))
    for name, section in cell.file.devices.items():
        wire = serial_path(section.options)
        if wire is not None and name not in cell.file.emulators:
            yield from examine_device(name, section.driver, section.options, wire)


def serial_path(options: Mapping[str, Any]) -> str | None:
    """Return the path of the serial port or slcan adapter named by the options, if any."""
    found = options.get("port", options.get("channel"))
    return found if isinstance(found, str) and "/" in found and "://" not in found else None


def can_adapters(
    *, uses_can: bool, search: Callable[[], list[dict[str, Any]]] = find_adapters
) -> Iterator[WireFinding]:
    """List the CAN adapters of this machine, each with the options that select it.

    Args:
        uses_can: whether the cell has CAN devices, so that it is worth saying that there is no adapter.
        search: finds the adapters.
    """
    found = search()
    for adapter in found:
        subject = f"CAN {adapter.get('interface')} {adapter.get('channel', '')}".rstrip()
        options = ", ".join(f"{key} = {json.dumps(value)}" for key, value in adapter.items())
        yield WireFinding(subject, True, f"found: {options}")
    if uses_can and not found:
        what = "python-can finds none; an slcan adapter is a serial port"
        yield WireFinding("CAN adapters", True, what, "install the maker's driver, or set a SocketCAN interface up")


def examine_port(path: str, *, sysfs: Path = SYSFS) -> WireFinding:
    """Check whether the port exists, may be opened, is held by a process, and how long its adapter buffers bytes.

    Args:
        sysfs: directory where the kernel describes serial ports.
    """
    if not Path(path).exists():
        return WireFinding(path, False, "does not exist", "plug the device in, or correct the path in the cell file")
    if not os.access(path, os.R_OK | os.W_OK):
        hint = "add your user to the group that owns the port, usually `dialout`, and log in again"
        return WireFinding(path, False, "you may not open it", hint)
    if (owner := port_owner(path)) is not None:
        return WireFinding(path, False, f"taken by {owner}", "close that program or choose another port")
    timer_ms = latency_timer_ms(path, sysfs=sysfs)
    if timer_ms is None:
        return WireFinding(path, True, "free; its driver has no latency timer")
    return WireFinding(path, True, f"free; latency timer {timer_ms} ms", TIMER_HINT if timer_ms > SLOW_TIMER_MS else "")


def examine_device(
    name: str,
    driver: str,
    options: dict[str, Any],
    path: str,
    *,
    open_device: Connect | None = None,
    look_at: Callable[[str], WireFinding] = examine_port,
) -> Iterator[WireFinding]:
    """Examine the device's port, then the device as configured; if it gives no data, try other baud rates.

    Args:
        open_device: connects by name, driver and options; by default uses the installed drivers.
        look_at: function that examines the port.
    """
    port = look_at(path)
    if not port.is_good:
        yield WireFinding(name, False, f"{path} {port.what}", port.hint)
        return
    opened = open_device or _connect
    try:
        with closing(opened(name, driver, options)) as device:
            yield WireFinding(name, True, measured(device))
        return
    except CellError as error:
        told = error
    baud = _answering_baud(name, driver, options, opened) if isinstance(told, DeviceUnavailable) else None
    if baud is None:
        yield WireFinding(name, False, told.what, told.hint)
    else:
        yield WireFinding(name, False, f"wrong baud rate: it answers at {baud}", f"set `baud = {baud}` in its options")


def _connect(name: str, driver: str, options: dict[str, Any]) -> Any:
    return connect(Context(name=name), driver, options)


def _answering_baud(name: str, driver: str, options: dict[str, Any], opened: Connect) -> int | None:
    for baud in BAUDS:
        if baud == options.get("baud"):
            continue
        try:
            opened(name, driver, {**options, "baud": baud}).close()
        except CellError:  # also raised by a driver that does not support the rate
            continue
        return baud
    return None


def measured(device: Any) -> str:
    """Return, as text, the sample rate, the age of readings and the wait for a new sample."""
    if not isinstance(device, WireDevice):
        return "answers"
    clock = WallClock()
    ages_s, waits_s, started_s, before = list[float](), list[float](), time.monotonic(), device.mailbox.published
    for _ in range(SAMPLES):
        asked_s = clock.now_s()
        sample = device.newest(Deadline.after(clock, 2.0), not_before_s=asked_s)
        waits_s.append(clock.now_s() - asked_s)
        ages_s.append(clock.now_s() - sample.host_time_s)
    rate_hz = (device.mailbox.published - before) / (time.monotonic() - started_s)
    wait_ms, age_ms = 1e3 * statistics.median(waits_s), 1e3 * statistics.median(ages_s)
    who = f" ({device.identified})" if device.identified else ""
    return f"{device.link_name()}{who}: {rate_hz:.0f} samples/s, new one after {wait_ms:.1f} ms, {age_ms:.1f} ms old (medians)"
