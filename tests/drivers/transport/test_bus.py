"""Tests of a bus shared by its owner thread and callers, and of the ages of samples from emulated devices."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.transport.bus import Bus
from drivers.transport.device import PATIENCE, WireDevice
from drivers.transport.link import Link, now_s
from hal.clock import PacedClock
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.registry import Context
from tests.drivers.rigs import ScriptLink, until

WIRE_CELL = Path(__file__).parents[3] / "cells" / "wire-ur.toml"


class Greedy:
    """Station that is always due and occupies the bus for two milliseconds."""

    period_s = 1e-4

    def __init__(self) -> None:
        self.polls = 0
        self._rest = threading.Event()

    def set_up(self, client: Link) -> None:
        """Do nothing, because there is nothing to set up."""

    def poll(self, client: Link) -> None:
        self.polls += 1
        self._rest.wait(0.002)

    def fail(self, error: Exception) -> None:
        """Do nothing; never called in these tests."""


@pytest.fixture
def greedy() -> Iterator[tuple[Bus[Link], Greedy]]:
    station = Greedy()
    bus: Bus[Link] = Bus("test", open_link=ScriptLink, client=lambda link: link)
    bus.attach(station)
    until(lambda: station.polls > 3)
    yield bus, station
    bus.close()


class LateLock:
    """Lock as seen by a caller on a busy machine, who gets it only if it is free at a moment when the caller runs."""

    def __init__(self) -> None:
        self._inner, self._rest = threading.Lock(), threading.Event()

    def acquire(self, *, timeout: float) -> bool:
        end_s = now_s() + timeout
        while not self._inner.acquire(blocking=False):
            if now_s() >= end_s:
                return False
            self._rest.wait(0.005)
        return True

    def release(self) -> None:
        self._inner.release()

    def __enter__(self) -> None:
        self._inner.acquire()

    def __exit__(self, *_: object) -> None:
        self._inner.release()


def test_a_slow_caller_gets_a_bus_that_is_polled_without_a_pause(
    greedy: tuple[Bus[Link], Greedy], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, station = greedy
    monkeypatch.setattr(bus, "_lock", LateLock())
    polls_awaited, calls = 0, 10
    for _ in range(calls):
        begun = station.polls
        until(lambda begun=begun: station.polls > begun + 1)
        before = station.polls
        assert bus.call(lambda _, until_s: until_s, now_s() + 30.0) > 0.0
        polls_awaited += station.polls - before
    assert polls_awaited < 4 * calls


def test_callers_without_a_pause_do_not_keep_the_polls_away(greedy: tuple[Bus[Link], Greedy]) -> None:
    bus, station = greedy
    is_over, before = threading.Event(), station.polls

    def call() -> None:
        while not is_over.is_set():
            bus.call(lambda _, until_s: until_s, now_s() + 30.0)

    threads = [threading.Thread(target=call, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    until(lambda: station.polls > before + 5)
    is_over.set()
    for thread in threads:
        thread.join(30.0)
    assert not any(thread.is_alive() for thread in threads)


class Silent(WireDevice[int]):
    """Device that publishes the values that a test gives it."""

    kind = DeviceKind.ARM

    def is_up(self) -> bool:
        return True

    def reconnects(self) -> int:
        return 0

    def link_name(self) -> str:
        return "test"

    def release(self) -> None:
        """Do nothing, because there is nothing to release."""


def slow_world(_: float) -> float:
    end_s = time.monotonic() + 0.05
    while time.monotonic() < end_s:
        pass
    return 0.0


@pytest.mark.parametrize(("name", "patience"), [("arm", PATIENCE), ("wrist_camera", 1.0)])
def test_what_an_emulated_wire_brings_ages_in_the_time_of_its_world(name: str, patience: float) -> None:
    """A tick of 2 ms that takes 50 ms of wall time ages an emulated device's sample by 2 ms, a real one's by 50 ms."""
    clock = PacedClock(slow_world)
    device = Silent(Context(name=name, clock=clock, cell=load_cell(WIRE_CELL)), max_age_s=0.02)
    clock.sleep(0.002)
    asked_s = now_s()
    clock.sleep(0.002)
    device.publish(1, valid_s=asked_s)
    sample = device.mailbox.peek()
    assert sample is not None
    age_s = sample.age_s(clock.now_s())
    assert device.patience == patience
    if device.is_emulated:
        assert age_s == pytest.approx(0.002)
    else:
        assert age_s >= 0.05
