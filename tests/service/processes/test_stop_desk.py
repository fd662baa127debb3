"""A reset clears only a stop that somebody has seen, and only while the stop port answers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.errors import MotionRefused
from service.processes.latch import Latch, LatchState, StopLevel
from service.processes.stop_desk import Records, StopDesk


class Host:
    """Writes the latch at once, unless it is not `alive`."""

    pid = None

    def __init__(self, latch: Latch) -> None:
        self.latch = latch
        self.alive = True

    def stop(self, source: str, level: StopLevel = StopLevel.OFF) -> LatchState:
        return self.latch.set(source, level)

    def reset(self, source: str, *, seen_count: int) -> bool:
        if not self.alive:
            raise MotionRefused("the stop process is down", hint="wait")
        return self.latch.reset(source, seen_count=seen_count)

    def is_alive(self) -> bool:
        return self.alive

    def close(self) -> None: ...


@pytest.fixture
def latch(tmp_path: Path) -> Iterator[Latch]:
    with Latch.create(tmp_path / "latch") as latch:
        yield latch


def test_a_reset_without_a_count_clears_no_stop_of_this_moment(latch: Latch) -> None:
    desk = StopDesk(latch, Host(latch), Records())
    desk.stop("a person")
    with pytest.raises(MotionRefused, match="ago, so it stays latched"):
        desk.reset("test", seen_count=None)
    assert latch.is_set()
    assert not desk.reset("test", seen_count=latch.state().count).is_latched


def test_a_reset_without_a_stop_port_is_refused_and_recorded_as_refused(latch: Latch) -> None:
    host = Host(latch)
    recorded: list[str] = []

    def told(kind: str, _data: object) -> None:
        recorded.append(kind)

    desk = StopDesk(latch, host, Records(note=told, commit=told))
    host.alive = False
    with pytest.raises(MotionRefused, match="stop process is down"):
        desk.reset("test", seen_count=desk.stop("a person").count)
    assert latch.is_set()
    assert recorded == ["stop", "stop-reset", "stop-reset-refused"]


def test_a_reset_of_a_clear_stop_is_no_change_that_could_end_a_task(latch: Latch) -> None:
    recorded: list[str] = []
    desk = StopDesk(latch, Host(latch), Records(commit=lambda kind, _data: recorded.append(kind)))
    clear = desk.reset("test", seen_count=desk.stop("a person").count)
    assert desk.reset("test", seen_count=clear.count) == desk.reset("test", seen_count=None) == clear
    assert recorded == ["stop", "stop-reset"]
    with pytest.raises(MotionRefused, match="pressed again"):
        desk.reset("test", seen_count=clear.count - 1)
