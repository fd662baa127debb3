"""A silent process that hangs is told from one that computes and from one for which a busy machine has no time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hal.process_state import ThreadTimes
from service.processes.beat import STILL_S
from service.processes.hang import LONGEST_STEP_S, Conduct, Hang

STEP_S = 0.02
BEATING = 2
ASLEEP = ThreadTimes(state="S", computed_s=1.0, waited_s=1.0, turns=100)


class Watched:
    """A process of two threads: one does what each step says, the other gives the heartbeat."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.working = self.beating = ASLEEP
        self.a_moment_later: ThreadTimes | None = None
        self.hang = Hang(
            lambda _pid: {1: self.working, BEATING: self.beating},
            lambda _pid, name: self.a_moment_later or {1: self.working, BEATING: self.beating}[name],
            lambda: self.now_s,
        )
        self.hang.look(7, BEATING)

    def step(
        self, *, state: str = "S", turns: int = 0, computed_s: float = 0.0, waited_s: float = 0.0, gap_s: float = STEP_S
    ) -> None:
        self.working = replace(
            self.working,
            state=state,
            turns=self.working.turns + turns,
            computed_s=self.working.computed_s + computed_s,
            waited_s=self.working.waited_s + waited_s,
        )
        self.beating = replace(self.beating, computed_s=self.beating.computed_s + 1e-4, turns=self.beating.turns + 3)
        self.now_s += gap_s
        self.hang.look(7, BEATING)

    def seen(self) -> Conduct:
        return self.hang.look(7, BEATING)


def test_threads_that_sleep_and_wake_for_moments_stand_still() -> None:
    watched = Watched()
    for _ in range(3):
        watched.step()
    seen = watched.seen()
    assert seen.still_s == seen.asleep_s == pytest.approx(3 * STEP_S)
    assert seen.wakes == 9
    assert seen.computed_s == pytest.approx(3e-4)


def test_a_thread_that_computes_is_no_standstill_and_its_time_is_added_up() -> None:
    watched = Watched()
    for _ in range(3):
        watched.step(computed_s=0.9 * STEP_S, state="R")
    assert watched.seen() == Conduct(computed_s=pytest.approx(3 * (0.9 * STEP_S + 1e-4)))


def test_of_several_cores_no_more_than_the_time_that_passed_counts() -> None:
    watched = Watched()
    watched.step(computed_s=5.0 * STEP_S, state="R")
    assert watched.seen() == Conduct(computed_s=pytest.approx(STEP_S))


BUSY = [
    {"waited_s": 0.8 * STEP_S},  # it got a turn after a long wait
    {"state": "R"},  # it waits for a turn, and the system does not count the wait before its end
    {"state": "D"},  # it waits for a disk
]


@pytest.mark.parametrize("busy", BUSY)
def test_a_process_that_the_machine_keeps_waiting_neither_hangs_nor_computes(busy: dict[str, float | str]) -> None:
    watched = Watched()
    for _ in range(50):
        watched.step(**busy)  # type: ignore[arg-type]  # each value has the type of its key
    seen = watched.seen()
    assert (seen.still_s, seen.wakes, seen.asleep_s) == (0.0, 0, 0.0)
    assert seen.computed_s < 0.01


@pytest.mark.parametrize("busy", [*BUSY, {"waited_s": 0.2 * STEP_S}])
def test_all_threads_are_asleep_only_without_a_break(busy: dict[str, float | str]) -> None:
    watched = Watched()
    watched.step()
    watched.step(**busy)  # type: ignore[arg-type]  # each value has the type of its key
    assert watched.seen().asleep_s == 0.0
    watched.step()
    assert watched.seen().asleep_s == pytest.approx(STEP_S)


def test_a_thread_that_wakes_at_the_moment_of_the_look_is_asked_again() -> None:
    watched = Watched()
    watched.a_moment_later = ASLEEP
    watched.step(state="R", turns=1)
    assert watched.seen().still_s == pytest.approx(STEP_S)


def test_a_thread_that_had_no_turn_since_the_last_look_waits_for_one_though_it_has_it_a_moment_later() -> None:
    watched = Watched()
    watched.a_moment_later = ASLEEP
    watched.step(state="R")
    assert watched.seen().still_s == 0.0


def test_one_look_after_a_long_gap_shows_no_hang() -> None:
    watched = Watched()
    watched.step(gap_s=5.0)
    assert watched.seen().still_s < STILL_S


def test_an_observer_that_was_kept_waiting_itself_counts_little_of_the_gap() -> None:
    watched = Watched()
    watched.step(gap_s=5.0)
    assert watched.seen().still_s == pytest.approx(LONGEST_STEP_S)


def test_a_heartbeat_and_another_process_begin_anew() -> None:
    watched = Watched()
    watched.step()
    watched.hang.forget()
    assert watched.hang.look(7, BEATING) == Conduct()
    watched.step()
    assert watched.hang.look(8, BEATING) == Conduct()


def test_without_the_thread_of_the_heartbeat_nobody_wakes() -> None:
    watched = Watched()
    watched.now_s += STEP_S
    assert watched.hang.look(7, 99).wakes == 0


def test_where_the_system_tells_nothing_nothing_hangs() -> None:
    now_s = iter(range(100))
    hang = Hang(lambda _pid: {}, lambda _pid, _name: None, lambda: float(next(now_s)))
    assert [hang.look(7, BEATING) for _ in range(5)] == [Conduct()] * 5
