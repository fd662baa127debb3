"""A control thread that a driver blocks is noticed while the rest of its process lives, and a busy machine is not blamed."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from hal.process_state import ThreadTimes, thread_times
from service.processes.cell_lines import BLOCKED, note_to_line
from service.processes.control_watch import BLOCKED_COMMANDING_S, BLOCKED_S, GIVE_UP_S, Commanded, ControlWatch
from service.processes.vigil import Vigil
from tests.service.waiting import eventually

THREAD = 7
LOOK_S = 0.02


class Scene:
    """A watch on a thread whose conduct the test sets."""

    def __init__(self) -> None:
        self.time_s = 100.0
        self.thread: int | None = THREAD
        self.state, self.turns = "S", 1
        self.watch = ControlWatch(lambda: self.thread, times=self.times, now_s=lambda: self.time_s)

    def times(self, _pid: int, _thread: int) -> ThreadTimes:
        return ThreadTimes(state=self.state, computed_s=0.0, waited_s=0.0, turns=self.turns)

    def looks(self, seconds: float, *, turns: int = 0) -> str | None:
        """Look for a time; the thread has so many turns between two looks."""
        why = None
        for _ in range(round(seconds / LOOK_S)):
            self.time_s += LOOK_S
            self.turns += turns
            why = self.watch.why_blocked()
        return why


def test_a_thread_that_sleeps_in_a_call_is_noticed_within_120_ms_and_given_up_later() -> None:
    scene = Scene()
    assert scene.looks(1.0, turns=1) is None
    assert "control thread is blocked" in str(scene.looks(0.12 - LOOK_S))
    assert scene.watch.why_ended() is None
    scene.looks(GIVE_UP_S)
    assert scene.watch.why_ended() == "the control thread is blocked"
    assert scene.looks(LOOK_S, turns=1) is None and scene.watch.why_ended() is None


@pytest.mark.parametrize("state", ["R", "D"])
def test_a_thread_that_waits_for_a_processor_or_a_disk_is_not_blocked(state: str) -> None:
    scene = Scene()
    scene.state = state
    assert scene.looks(5.0) is None


def test_a_machine_that_stood_still_and_a_thread_that_may_sleep_are_not_blamed() -> None:
    scene = Scene()
    scene.looks(0.1, turns=1)
    scene.time_s += 10.0  # nobody ran
    assert scene.looks(LOOK_S) is None
    scene.thread = None
    assert scene.looks(5.0) is None
    scene.thread = THREAD + 1
    assert scene.looks(BLOCKED_S) is None, "another thread begins anew"


def test_a_command_may_wait_longer_than_a_read() -> None:
    scene = Scene()

    class Arm:
        name = "arm"

        def enable(self, *, seconds: float) -> str | None:
            return scene.looks(seconds)

        def read(self, seconds: float) -> str | None:
            return scene.looks(seconds)

    arm: Any = Commanded(Arm(), scene.watch, "enable")
    scene.looks(0.1, turns=1)
    assert arm.name == "arm"
    assert arm.enable(seconds=0.3) is None
    scene.looks(0.1, turns=1)
    assert arm.read(0.12) is not None
    scene.looks(0.1, turns=1)
    assert arm.enable(seconds=BLOCKED_COMMANDING_S + 2 * LOOK_S) is not None


def test_a_real_thread_in_a_call_that_does_not_come_back_is_noticed_and_one_that_ticks_is_not() -> None:
    blocked, release, ticking = threading.Event(), threading.Event(), threading.Event()

    def control() -> None:
        while not blocked.is_set():
            release.wait(0.002)
            ticking.set()
        release.wait()

    thread = threading.Thread(target=control, daemon=True)
    thread.start()
    assert ticking.wait(10.0)
    times: list[ThreadTimes | None] = []

    def noted(pid: int, name: int) -> ThreadTimes | None:
        times.append(thread_times(pid, name))
        return times[-1]

    watch = ControlWatch(lambda: thread.native_id, times=noted)
    if thread_times(1, 1) is None and noted(1, thread.native_id or 0) is None and not Path("/proc/self/task").exists():
        pytest.skip("the operating system does not tell what threads do")
    blocked.set()
    eventually(watch.why_blocked)
    release.set()
    thread.join(10.0)


def test_the_cell_tells_of_a_blocked_thread_once_and_counts_it_as_a_stop(tmp_path: Path) -> None:
    class Line:
        def __init__(self) -> None:
            self.lines: list[str] = []

        def write_line(self, line: str) -> None:
            self.lines.append(line)

    line: Any = Line()
    why: list[str | None] = [None]
    vigil = Vigil(tmp_path, line, silence_s=600.0)
    vigil.watch(lambda: None, lambda: why[0])
    vigil.look()
    assert not vigil.is_blocked and line.lines == []
    why[0] = "the control thread is blocked"
    vigil.look()
    vigil.look()
    assert vigil.is_blocked and line.lines == [note_to_line(BLOCKED, {"why": why[0]})]
    why[0] = None
    vigil.look()
    assert not vigil.is_blocked
