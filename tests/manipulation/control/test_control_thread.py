"""Tests of the thread that runs the work of callers."""

from __future__ import annotations

import threading

import pytest

from hal.errors import MotionRefused
from manipulation.control.control_thread import ControlThread

PATIENCE_S = 10.0


def quiet() -> None:
    """Do nothing."""


@pytest.mark.parametrize("beats", [False, True])
def test_calls_run_on_one_thread_and_their_values_come_back(beats: bool) -> None:
    thread = ControlThread(beat=quiet if beats else None, at_end=quiet)
    thread.start()
    thread.start()
    names = {thread.do(lambda: threading.current_thread().name) for _ in range(3)}
    thread.close()
    assert names == {"control"}


def test_an_error_belongs_to_its_caller_and_the_thread_lives_on() -> None:
    thread = ControlThread(beat=None, at_end=quiet)
    thread.start()
    with pytest.raises(ZeroDivisionError):
        thread.do(lambda: 1 // 0)
    assert thread.do(lambda: 7) == 7
    thread.close()


def test_it_beats_until_it_is_closed_and_then_ends_once() -> None:
    beaten, ended = threading.Event(), []
    thread = ControlThread(beat=beaten.set, at_end=lambda: ended.append(threading.current_thread().name))
    thread.start()
    assert beaten.wait(PATIENCE_S)
    thread.close()
    thread.close()
    assert ended == ["control"]


def test_a_beat_that_fails_ends_the_thread_and_whoever_asks_is_refused() -> None:
    may_fail, ended = threading.Event(), threading.Event()

    def beat() -> None:
        if may_fail.wait(PATIENCE_S):
            raise ZeroDivisionError("a defect")

    thread = ControlThread(beat=beat, at_end=ended.set)
    thread.start()
    may_fail.set()
    assert ended.wait(PATIENCE_S)
    with pytest.raises(MotionRefused, match="does not run"):
        thread.do(quiet)


def test_before_start_and_after_close_it_refuses() -> None:
    thread = ControlThread(beat=None, at_end=quiet)
    with pytest.raises(MotionRefused, match="does not run"):
        thread.do(quiet)
    thread.start()
    thread.close()
    with pytest.raises(MotionRefused, match="does not run"):
        thread.do(quiet)


def test_whoever_asks_while_it_closes_gets_an_answer() -> None:
    thread = ControlThread(beat=None, at_end=quiet)
    begun, answers = threading.Event(), []

    def ask() -> None:
        begun.set()
        try:
            answers.append(thread.do(lambda: "done"))
        except MotionRefused as refusal:
            answers.append(refusal.what)

    thread.start()
    askers = [threading.Thread(target=ask) for _ in range(20)]
    for asker in askers:
        asker.start()
    assert begun.wait(PATIENCE_S)
    thread.close()
    for asker in askers:
        asker.join(PATIENCE_S)
    assert len(answers) == len(askers)
    assert set(answers) <= {"done", "the controller was closed", "the controller does not run"}
