"""A process that ends, is suspended or falls silent is noticed by its heartbeat."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from numba.core.compiler_lock import global_compiler_lock

import hal.jit  # noqa: F401 - the compiler of this project declares its pauses
from hal import pauses
from hal.process_state import ProcessState, process_state
from service.processes.beat import ASLEEP_S, LOOK_S, STILL_S, Beat
from service.processes.latch import Latch, StopLevel
from service.processes.watchdog import LOOP_SILENT_S, Watchdog
from tests.service.waiting import eventually

BEATS = """
import ctypes, pathlib, signal, sys
from service.processes.beat import Beat, every_beat

signal.signal(signal.SIGUSR1, lambda *_: ctypes.PyDLL(None).sleep(600))  # its calls keep the lock of Python
signal.signal(signal.SIGUSR2, lambda *_: sum(range(10**12)))
signal.signal(signal.SIGALRM, lambda *_: ended.set())
beat = Beat(pathlib.Path(sys.argv[1]), "cell")
ended = every_beat(beat.beat, name="heartbeat")
while True:
    signal.pause()
"""


@pytest.fixture
def other(tmp_path: Path) -> Iterator[tuple[Beat, int]]:
    """Yield the heartbeat and the id of another process that gives it all the time."""
    beat = Beat(tmp_path, "cell")
    with subprocess.Popen([sys.executable, "-c", BEATS, str(tmp_path)]) as process:
        eventually(lambda: beat.age_s() < LOOK_S)
        yield beat, process.pid
        process.kill()


def test_nothing_is_lost_before_its_first_heartbeat(tmp_path: Path) -> None:
    beat = Beat(tmp_path, "cell")
    assert beat.age_s() > 1.0
    assert beat.lost(silence_s=0.0) is None
    beat.beat()
    assert beat.age_s() < 1.0


def test_a_suspended_process_is_lost_until_it_goes_on(other: tuple[Beat, int]) -> None:
    beat, pid = other
    assert beat.lost(silence_s=600.0) is None
    os.kill(pid, signal.SIGSTOP)
    assert eventually(lambda: beat.lost(silence_s=600.0)) == ProcessState.SUSPENDED
    os.kill(pid, signal.SIGCONT)
    eventually(lambda: beat.lost(silence_s=600.0) is None)


def test_a_process_whose_threads_all_wait_for_one_that_sleeps_is_lost_long_before_its_time(
    other: tuple[Beat, int],
) -> None:
    beat, pid = other
    os.kill(pid, signal.SIGUSR1)
    assert "hangs" in str(eventually(lambda: beat.lost(silence_s=600.0)))
    assert beat.age_s() < ASLEEP_S, "the heartbeat asks for the lock again and again"


def test_a_heartbeat_that_only_sleeps_for_long_is_the_machines_until_a_second_has_passed(
    other: tuple[Beat, int],
) -> None:
    beat, pid = other
    os.kill(pid, signal.SIGALRM)  # all threads sleep, as where a virtual machine gets no processor of its host
    assert eventually(lambda: beat.age_s() > 2 * (LOOK_S + STILL_S))
    while beat.age_s() < 0.9 * ASLEEP_S:
        assert beat.lost(silence_s=600.0) is None
    assert "hangs" in str(eventually(lambda: beat.lost(silence_s=600.0)))


def test_a_process_that_computes_and_never_gives_a_heartbeat_is_lost(other: tuple[Beat, int]) -> None:
    beat, pid = other
    os.kill(pid, signal.SIGUSR2)
    assert "no sign of life" in str(eventually(lambda: beat.lost(silence_s=600.0), timeout_s=60.0))


def test_a_declared_pause_is_no_loss_and_its_end_is_a_heartbeat(tmp_path: Path) -> None:
    beat = Beat(tmp_path, "cell")
    beat.pause(True)
    eventually(lambda: beat.age_s() > LOOK_S)
    assert beat.lost(silence_s=0.0) is None
    late_s = beat.age_s()
    beat.pause(False)
    assert beat.age_s() < late_s
    assert "no sign of life" in str(eventually(lambda: beat.lost(silence_s=0.0)))
    beat.close()
    beat.pause(True)  # does nothing


def test_the_compiler_declares_its_pauses_and_nested_ones_count_as_one() -> None:
    told: list[bool] = []
    end = pauses.tell(told.append)
    with global_compiler_lock, global_compiler_lock:
        assert told == [True]
    assert told == [True, False]
    with pauses.declared(), pauses.declared():
        assert told == [True, False, True]
    assert told == [True, False, True, False]
    end()
    with pauses.declared():
        assert len(told) == 4


def test_a_killed_process_is_lost_although_its_parent_has_not_asked_for_it(other: tuple[Beat, int]) -> None:
    beat, pid = other
    os.kill(pid, signal.SIGKILL)
    assert eventually(lambda: beat.lost(silence_s=600.0)) == ProcessState.ENDED


def test_a_process_that_runs_and_is_silent_is_lost_after_its_time(tmp_path: Path) -> None:
    beat = Beat(tmp_path, "cell")
    beat.beat()
    assert "no sign of life" in str(eventually(lambda: beat.lost(silence_s=0.0)))
    assert beat.lost(silence_s=600.0) is None


def test_no_reader_in_another_process_ever_sees_half_a_beat(other: tuple[Beat, int]) -> None:
    beat, _ = other
    assert max(beat.age_s() for _ in range(500_000)) < 600.0, "a torn number looks hours old"


@pytest.mark.parametrize("name", ["service", "cell"])
def test_the_stop_process_latches_for_each_process_that_is_lost(tmp_path: Path, name: str) -> None:
    latch, beat = Latch.create(tmp_path / "latch"), Beat(tmp_path, name)
    watchdog = Watchdog(latch, tmp_path, silence_s=0.0)
    latch.reset("test", seen_count=latch.state().count)
    watchdog.look()
    assert not latch.is_set(), "nobody has begun to give heartbeats"
    beat.beat()
    eventually(lambda: (watchdog.look(), latch.is_set())[1])
    assert latch.state().source.startswith(f"the {name} process gave no sign of life")
    count = latch.state().count
    watchdog.look()
    assert latch.state().count == count, "one loss is one stop"


@pytest.mark.parametrize(("name", "level"), [("service", StopLevel.RETREAT), ("cell", StopLevel.OFF)])
def test_the_cell_file_chooses_what_the_loss_of_the_service_does_and_no_more(
    tmp_path: Path, name: str, level: StopLevel
) -> None:
    latch, beat = Latch.create(tmp_path / "latch"), Beat(tmp_path, name)
    watchdog = Watchdog(latch, tmp_path, silence_s=0.0, service_lost=StopLevel.RETREAT)
    latch.reset("test", seen_count=latch.state().count)
    beat.beat()
    eventually(lambda: (watchdog.look(), latch.is_set())[1])
    count = latch.state().count
    watchdog.look()
    assert (latch.state().level, latch.state().count) == (level, count)


def test_the_loss_of_the_cell_ends_the_way_back_of_an_arm_without_its_service(tmp_path: Path) -> None:
    latch, service, cell = Latch.create(tmp_path / "latch"), Beat(tmp_path, "service"), Beat(tmp_path, "cell")
    watchdog = Watchdog(latch, tmp_path, silence_s=0.0, service_lost=StopLevel.RETREAT)
    latch.reset("test", seen_count=latch.state().count)
    service.beat()
    eventually(lambda: (watchdog.look(), latch.goes_back())[1])
    cell.beat()
    eventually(lambda: (watchdog.look(), latch.has(StopLevel.OFF))[1])


def test_the_loss_of_a_process_makes_a_stop_that_holds_one_that_switches_off(tmp_path: Path) -> None:
    latch, beat = Latch.create(tmp_path / "latch"), Beat(tmp_path, "service")
    watchdog = Watchdog(latch, tmp_path, silence_s=0.0)
    latch.reset("test", seen_count=latch.state().count)
    latch.set("a person", StopLevel.HOLD)
    assert latch.keeps_power()
    beat.beat()

    def is_off() -> bool:
        watchdog.look()
        return not latch.keeps_power()

    eventually(is_off)
    assert latch.is_set()


def test_the_heartbeat_of_the_stop_process_waits_for_an_event_loop_that_keeps_the_lock_of_python(
    tmp_path: Path,
) -> None:
    """Readers tell a hang from the thread of the heartbeat, which must not be the one that hangs."""
    watchdog, beat = Watchdog(Latch.create(tmp_path / "latch"), tmp_path, silence_s=0.0), Beat(tmp_path, "stop")

    async def until_it_beats() -> int:
        async with watchdog.running():
            while beat._pid[0] == 0:  # noqa: ASYNC110 - in shared memory
                await asyncio.sleep(0)
        return int(beat._thread[0])

    assert asyncio.run(until_it_beats()) != threading.get_native_id()
    assert not [thread for thread in threading.enumerate() if thread.name == "heartbeat"]


def test_the_stop_process_gives_no_heartbeat_while_its_event_loop_shows_no_life(tmp_path: Path) -> None:
    watchdog, beat = Watchdog(Latch.create(tmp_path / "latch"), tmp_path, silence_s=0.0), Beat(tmp_path, "stop")
    watchdog._loop_lived_s -= LOOP_SILENT_S
    watchdog.look()
    assert beat._pid[0] == 0
    watchdog._loop_lived_s += 3600.0
    watchdog.look()
    assert beat._pid[0] == os.getpid()


def test_the_state_of_a_process_is_that_of_the_operating_system() -> None:
    assert process_state(os.getpid()) is ProcessState.RUNS
    with subprocess.Popen([sys.executable, "-c", "pass"]) as process:
        assert eventually(lambda: process_state(process.pid) is ProcessState.ENDED), "also before it is waited for"
    assert process_state(process.pid) is ProcessState.ENDED
