"""Tests of the link to the world process: a world of another format is not used."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hal.process_state import ThreadTimes, threads_of
from simbackend.link import COMPUTING_S, PATIENCE_S, STILL_S, Debt, complaint_of
from simbackend.wire import REQUEST, SNAPSHOT


@pytest.mark.parametrize("answer", [(REQUEST, SNAPSHOT + 1), (REQUEST - 1, SNAPSHOT), None])
def test_a_world_whose_vectors_have_another_length_is_refused(answer: object) -> None:
    told = complaint_of(answer)
    assert told is not None and str(answer) in told and str(SNAPSHOT) in told


def test_a_world_that_says_why_it_did_not_start_is_quoted_and_one_of_the_same_format_is_used() -> None:
    assert complaint_of("ConfigError: no panel") == "ConfigError: no panel"
    assert complaint_of((REQUEST, SNAPSHOT)) is None


class World:
    """A world that owes an answer, and what its threads do; `looks` passes time in the steps of the cell's watch."""

    def __init__(self) -> None:
        self.now_s = self.asked_at_s = 100.0
        self.thread = ThreadTimes(state="S", computed_s=5.0, waited_s=0.0, turns=7)
        self.debt = Debt(lambda _pid: {1: self.thread})

    def looks(self, seconds: float, *, state: str = "S", computes: float = 0.0) -> str | None:
        why = None
        for _ in range(round(seconds / 0.02)):
            self.now_s += 0.02
            computed_s = self.thread.computed_s + 0.02 * computes
            turns = self.thread.turns + (computes > 0.0)
            self.thread = ThreadTimes(state=state, computed_s=computed_s, waited_s=0.0, turns=turns)
            why = why or self.debt.look(1, self.asked_at_s, self.now_s)
        return why


def test_a_world_that_owes_an_answer_and_does_nothing_hangs() -> None:
    world = World()
    assert world.looks(PATIENCE_S + STILL_S - 0.1) is None
    assert "done nothing" in str(world.looks(0.3))


def test_a_world_that_computes_for_too_long_hangs_and_one_that_gets_no_processor_does_not() -> None:
    slow, endless, busy = World(), World(), World()
    assert slow.looks(10.0, computes=0.3) is None
    assert "computed" in str(endless.looks(PATIENCE_S + COMPUTING_S + 0.2, state="R", computes=1.0))
    assert busy.looks(15.0, state="R") is None and busy.looks(1.0, state="D") is None


def test_each_answer_has_its_own_time() -> None:
    world = World()
    for _ in range(5):
        assert world.looks(PATIENCE_S + STILL_S - 0.1) is None
        world.asked_at_s = world.now_s
    assert World().debt.look(1, None, 1e6) is None


def test_a_real_process_that_sleeps_hangs() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", "print(1, flush=True); import time; time.sleep(600)"], stdout=-1
    ) as one:
        assert one.stdout is not None and one.stdout.readline()
        if not threads_of(one.pid):
            one.kill()
            pytest.skip("the operating system does not tell what threads do")
        debt, now_s, why = Debt(), 100.0, None
        while why is None and now_s < 200.0:
            now_s += 0.02
            why = debt.look(one.pid, 0.0, now_s)
        one.kill()
    assert "done nothing" in str(why)
