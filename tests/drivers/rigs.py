"""Test rigs of devices on links: an emulator, its driver, and functions that disturb the link."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from drivers.emulators.base import WireEmulator
from drivers.transport.link import now_s
from hal.clock import Deadline, WallClock
from hal.conformance import Rig
from hal.errors import CellError
from hal.readings import Quality
from hal.registry import Context, connect

CLOCK = WallClock()


def soon(duration_s: float = 1.0) -> Deadline:
    """Return a deadline on the wall clock."""
    return Deadline.after(CLOCK, duration_s)


def later(duration_s: float = 1.0) -> float:
    """Return a time limit on the clock of the links, in seconds."""
    return now_s() + duration_s


class ScriptLink:
    """Link with a list of answers; each write moves the next answer into the receive buffer."""

    name = "script"
    byte_s = 0.0

    def __init__(self, *answers: bytes) -> None:
        self.answers = list(answers)
        self.written: list[bytes] = []
        self.ready = b""

    def read(self, until_s: float) -> bytes:
        chunk, self.ready = self.ready, b""
        return chunk

    def write(self, data: bytes, until_s: float) -> None:
        self.written.append(data)
        self.ready += self.answers.pop(0) if self.answers else b""

    def is_present(self) -> bool:
        return True

    def close(self) -> None:
        self.ready = b""


def until(condition: Callable[[], bool], within_s: float = 5.0) -> None:
    """Wait until `condition` holds; fail if it never does."""
    give_up = soon(within_s)
    rest = threading.Event()
    while not condition():
        assert not give_up.is_past(), "it did not happen"
        rest.wait(0.002)


def count_good(device: Any, is_true: Callable[[Any], bool], *, wanted: int = 5, within_s: float = 8.0) -> int:
    """Read samples over a faulty link until `wanted` have come; all must be true, and errors must name the device."""
    give_up = soon(within_s)
    rest = threading.Event()
    good = 0
    while good < wanted and not give_up.is_past():
        try:
            sample = device.newest(soon(0.4), not_before_s=CLOCK.now_s())
        except CellError as error:
            assert device.name in str(error)
            rest.wait(0.005)
            continue
        if sample.quality is not Quality.INVALID:
            assert is_true(sample.value), f"a wrong value got through: {sample.value}"
            good += 1
    return good


@contextmanager
def wired(emulator: WireEmulator, driver: str, options: dict[str, Any] | None = None) -> Iterator[Any]:
    """Yield the real driver connected to a running emulator; both are closed at the end."""
    device = None
    try:
        device = connect(Context(name="wired"), driver, {**emulator.address, **(options or {})})
        yield device
    finally:
        if device is not None:
            device.close()
        emulator.close()


@contextmanager
def wired_rig(
    emulator: WireEmulator, driver: str, options: dict[str, Any] | None = None, *, sample_period_s: float = 0.1
) -> Iterator[Rig[Any]]:
    """Yield a rig for the conformance tests."""
    with wired(emulator, driver, options) as device:
        yield Rig(device=device, clock=CLOCK, sample_period_s=sample_period_s, inject=emulator.inject)
