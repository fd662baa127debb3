"""What is wrong with a wire: ports, permissions, owners, latency timers, the baud rate that answers, measured latency.

`panelwright doctor` finds this by the entry point `panelwright.doctor`.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.transport.device import WireDevice
from drivers.transport.serial_link import SYSFS, latency_timer_ms, port_owner, serial_ports
from hal.clock import Deadline, WallClock
from hal.config import Cell
from hal.errors import CellError, ConfigError, DeviceUnavailable
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
)  # each costs seconds: usual ones first
SAMPLES = 30
SLOW_TIMER_MS = 2
TIMER_HINT = (
    "the drivers shorten it when they open the port, if they may; for good by a udev rule: "
    'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{latency_timer}="1"'
)
Connect = Callable[[str, str, dict[str, Any]], Any]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's report; `hint` says what to do when it is not good."""

    subject: str
    is_good: bool
    what: str
    hint: str = ""


def examine(cell: Cell) -> Iterator[Finding]:
    """Every serial port of this machine, then every device of the cell that has a wire of its own."""
    for path in serial_ports():
        yield examine_port(path)
    for name, section in cell.file.devices.items():
        wire = serial_path(section.options)
        if wire is not None and name not in cell.file.emulators:
            yield from examine_device(name, section.driver, section.options, wire)


def serial_path(options: Mapping[str, Any]) -> str | None:
    """The path of the serial port or slcan adapter that the options name, if they name one."""
    found = options.get("port", options.get("channel"))
    return found if isinstance(found, str) and "/" in found else None


def examine_port(path: str, *, sysfs: Path = SYSFS) -> Finding:
    """Is it there, may it be opened, does somebody have it, and how long does its adapter hold bytes back?

    Args:
        sysfs: where the kernel describes serial ports.
    """
    if not Path(path).exists():
        return Finding(path, False, "does not exist", "plug the device in, or correct the path in the cell file")
    if not os.access(path, os.R_OK | os.W_OK):
        hint = "add your user to the group that owns the port, usually `dialout`, and log in again"
        return Finding(path, False, "you may not open it", hint)
    if (owner := port_owner(path)) is not None:
        return Finding(path, False, f"taken by {owner}", "close that program or choose another port")
    timer_ms = latency_timer_ms(path, sysfs=sysfs)
    if timer_ms is None:
        return Finding(path, True, "free; its driver has no latency timer")
    return Finding(path, True, f"free; latency timer {timer_ms} ms", TIMER_HINT if timer_ms > SLOW_TIMER_MS else "")


def examine_device(
    name: str,
    driver: str,
    options: dict[str, Any],
    path: str,
    *,
    open_device: Connect | None = None,
    look_at: Callable[[str], Finding] = examine_port,
) -> Iterator[Finding]:
    """Its port, then the device as configured; when it gives no data, at which other baud rate it does.

    Args:
        open_device: connects by name, driver and options; the installed drivers unless given.
        look_at: what finds out about the port.
    """
    port = look_at(path)
    if not port.is_good:
        yield Finding(name, False, f"{path} {port.what}", port.hint)
        return
    opened = open_device or _connect
    try:
        with closing(opened(name, driver, options)) as device:
            yield Finding(name, True, measured(device))
        return
    except ConfigError:
        raise
    except CellError as error:
        told = error
    baud = _answering_baud(name, driver, options, opened) if isinstance(told, DeviceUnavailable) else None
    if baud is None:
        yield Finding(name, False, told.what, told.hint)
    else:
        yield Finding(name, False, f"wrong baud rate: it answers at {baud}", f"set `baud = {baud}` in its options")


def _connect(name: str, driver: str, options: dict[str, Any]) -> Any:
    return connect(Context(name=name), driver, options)


def _answering_baud(name: str, driver: str, options: dict[str, Any], opened: Connect) -> int | None:
    for baud in BAUDS:
        if baud == options.get("baud"):
            continue
        try:
            opened(name, driver, {**options, "baud": baud}).close()
        except CellError:  # also a driver that knows no such rate
            continue
        return baud
    return None


def measured(device: Any) -> str:
    """Rate, age of what is read and wait for a sample that is new."""
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
    return (
        f"{device.link_name()}: {rate_hz:.0f} samples/s, new one after {wait_ms:.1f} ms, {age_ms:.1f} ms old (medians)"
    )
