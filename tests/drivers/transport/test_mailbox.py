"""Tests of the mailbox between an owner thread and its readers."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.transport.link import now_s
from drivers.transport.mailbox import Mailbox
from hal.errors import CellError, DeviceFault, DeviceTimeout
from hal.readings import Stamped
from tests.drivers.rigs import later, until


@contextmanager
def reading(box: Mailbox[int]) -> Iterator[list[int | None]]:
    """Read in another thread; the yielded list holds the value after the `with` block, which waits for at most 30 s."""
    got: list[int | None] = []

    def read() -> None:
        sample = box.wait(oldest_host_s=0.0, until_s=later(60.0))
        got.append(None if sample is None else sample.value)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    yield got
    thread.join(30.0)


def test_the_mailbox_gives_the_newest_and_counts_what_a_slow_reader_lost() -> None:
    box: Mailbox[int] = Mailbox(ring=4)
    for i in range(1, 11):
        box.publish(Stamped(value=i, host_time_s=float(i), sequence=i))
    assert box.wait(oldest_host_s=0.0, until_s=now_s()) is box.peek()
    fresh, lost = box.since(2)
    assert [sample.value for sample in fresh] == [7, 8, 9, 10]
    assert lost == 4
    assert box.wait(oldest_host_s=11.0, until_s=now_s()) is None


def test_an_error_reaches_all_readers_until_the_next_sample() -> None:
    box: Mailbox[int] = Mailbox()
    box.fail(DeviceFault("broken", hint="repair it"))
    for _ in range(2):
        with pytest.raises(DeviceFault, match="broken"):
            box.wait(oldest_host_s=0.0, until_s=later())
    box.publish(Stamped(value=1, host_time_s=1.0, sequence=1))
    assert box.wait(oldest_host_s=0.0, until_s=later()) is not None


def test_silence_is_the_answer_only_when_the_readers_time_is_over() -> None:
    box: Mailbox[int] = Mailbox()
    box.fail(DeviceTimeout("silent for 0.3 s", hint="check power"))
    with pytest.raises(DeviceTimeout, match="silent"):
        box.wait(oldest_host_s=0.0, until_s=now_s())
    with reading(box) as got:
        box.publish(Stamped(value=3, host_time_s=1.0, sequence=1))
    assert got == [3]


def test_a_waiting_reader_wakes_with_the_sample() -> None:
    box: Mailbox[int] = Mailbox()
    with reading(box) as got:
        until(lambda: len(box._bells) > 0)
        box.publish(Stamped(value=7, host_time_s=1.0, sequence=1))
    assert got == [7]


@pytest.fixture
def busy_switching() -> Iterator[None]:
    """Make the interpreter switch threads after nearly every instruction, to reveal race conditions."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-7)
    yield
    sys.setswitchinterval(before_s)


@pytest.mark.usefixtures("busy_switching")
def test_no_reader_misses_its_waking_and_none_gets_a_sample_twice() -> None:
    """Writer and readers run in lock step: a sample is published only when every reader waits or is about to wait."""
    box: Mailbox[int] = Mailbox()
    rounds, readers = 1000, 3
    got: list[list[int]] = [[] for _ in range(readers)]
    has_all = threading.Barrier(readers + 1)

    def read(mine: list[int]) -> None:
        for i in range(1, rounds + 1):
            sample = box.wait(oldest_host_s=float(i), until_s=later(60.0))
            mine.append(0 if sample is None else sample.value)
            has_all.wait(60.0)

    threads = [threading.Thread(target=read, args=(mine,), daemon=True) for mine in got]
    for thread in threads:
        thread.start()
    for i in range(1, rounds + 1):
        box.publish(Stamped(value=i, host_time_s=float(i), sequence=i))
        has_all.wait(30.0)  # after a lost wake-up the reader would wait for 60 s and break the barrier
    assert got == [list(range(1, rounds + 1))] * readers


@pytest.mark.usefixtures("busy_switching")
def test_every_sample_reaches_a_hurried_reader_once_or_is_counted_as_lost() -> None:
    box: Mailbox[int] = Mailbox(ring=8)
    most = 20_000
    writer = threading.Thread(
        target=lambda: [box.publish(Stamped(value=i, host_time_s=float(i), sequence=i)) for i in range(1, most + 1)]
    )
    seen, lost, last = list[int](), 0, 0
    writer.start()
    while last < most:
        fresh, missed = box.since(last)
        seen += [sample.sequence for sample in fresh]
        lost, last = lost + missed, seen[-1] if seen else 0
    writer.join(5.0)
    assert seen == sorted(set(seen))
    assert len(seen) + lost == most


def test_news_that_comes_between_a_readers_look_and_its_wait_is_not_missed() -> None:
    class NewsComesLate(Mailbox[int]):
        def peek(self) -> Stamped[int] | None:
            seen = super().peek()
            if seen is None:
                self.publish(Stamped(value=5, host_time_s=1.0, sequence=1))
            return seen

    with reading(NewsComesLate()) as got:
        pass
    assert got == [5]


def test_a_failure_wakes_all_readers() -> None:
    box: Mailbox[int] = Mailbox()
    errors: list[CellError] = []

    def read() -> None:
        try:
            box.wait(oldest_host_s=0.0, until_s=later(60.0))
        except CellError as error:
            errors.append(error)

    threads = [threading.Thread(target=read, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    box.fail(DeviceFault("broken", hint="repair it"))
    for thread in threads:
        thread.join(30.0)
    assert [error.what for error in errors] == ["broken"] * 3
    assert len({id(error) for error in errors}) == 3, "each has its own traceback"
