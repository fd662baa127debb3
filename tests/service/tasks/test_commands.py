"""Commands are numbered upwards, begin in time or never, and sub-leases end with the lease or with their client."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.clock import SimClock
from hal.errors import LeaseError
from service.errors import Expired, StaleEpoch, StaleSequence, TooDistant
from service.tasks.lease import HORIZON_S, Command, LeaseDesk
from service.tasks.sub_leases import OWN_WINDOW_S

TTL_S = 2.0


@pytest.fixture
def clock() -> SimClock:
    return SimClock(start_s=100.0)


@pytest.fixture
def lease(clock: SimClock) -> LeaseDesk:
    return LeaseDesk(ttl_s=TTL_S, clock=clock)


def test_a_command_that_is_old_or_a_repeat_is_refused(lease: LeaseDesk) -> None:
    token = lease.acquire("alice").token
    for number in (3, 4, 10):
        assert lease.admit(Command(token=token, sequence=number)) == "alice"
    for number in (10, 9, 0):
        with pytest.raises(StaleSequence, match="10"):
            lease.admit(Command(token=token, sequence=number))
    with pytest.raises(StaleSequence, match="no number"):
        lease.admit(Command(token=token))
    fresh = lease.take_over("bob").token
    assert lease.admit(Command(token=fresh)) == "bob", "a new lease counts anew"
    assert lease.admit(Command(token=fresh, sequence=0)) == "bob"


@given(numbers=st.lists(st.integers(0, 20), max_size=30))
def test_of_any_numbers_exactly_the_records_are_admitted(numbers: list[int]) -> None:
    lease = LeaseDesk(ttl_s=TTL_S, clock=SimClock())
    token, admitted = lease.acquire("alice").token, []
    for number in numbers:
        try:
            lease.admit(Command(token=token, sequence=number))
            admitted.append(number)
        except StaleSequence:
            pass
    assert admitted == [n for at, n in enumerate(numbers) if n > max(numbers[:at], default=-1)]


def test_a_refused_command_uses_up_no_number(lease: LeaseDesk, clock: SimClock) -> None:
    token = lease.acquire("alice").token
    with pytest.raises(Expired):
        lease.admit(Command(token=token, sequence=7, until_s=clock.now_s() - 0.001))
    with pytest.raises(LeaseError):
        lease.admit(Command(token=None, sequence=7))
    assert lease.admit(Command(token=token, sequence=7)) == "alice"


def test_a_command_begins_in_time_or_never(lease: LeaseDesk, clock: SimClock) -> None:
    until_s = lease.clock_s() + HORIZON_S
    assert lease.admit(Command(until_s=until_s)) is None
    with pytest.raises(TooDistant, match="TOO_DISTANT"):
        lease.admit(Command(until_s=until_s + 0.001))
    clock.sleep(HORIZON_S)
    lease.check_in_time(Command(until_s=until_s))
    clock.sleep(0.001)
    with pytest.raises(Expired, match="EXPIRED"):
        lease.admit(Command(until_s=until_s))


def test_a_take_over_ends_the_sub_leases_that_were_lent_before_and_no_later_one(lease: LeaseDesk) -> None:
    lease.acquire("alice")
    lost: list[str] = []
    old = lease.lend(is_own=False)
    old.on_loss = lost.append
    lease.take_over("bob", reason="alice has left")
    new = lease.lend(is_own=False)
    assert lost == ["bob took the lease over from alice: alice has left"] or not lost
    with pytest.raises(StaleEpoch, match="bob took the lease over"):
        old.check()
    new.check()
    assert (old.name.split(".")[0], new.name.split(".")[0]) == ("1", "2")


def test_a_lapse_ends_them_and_a_release_does_not(lease: LeaseDesk, clock: SimClock) -> None:
    token = lease.acquire("alice").token
    kept = lease.lend(is_own=False)
    lease.release(token)
    clock.sleep(10 * TTL_S)
    lease.expire()
    kept.check()
    lease.acquire("alice")
    clock.sleep(TTL_S)
    lease.expire()
    with pytest.raises(StaleEpoch, match="lapsed"):
        kept.check()


def test_a_sub_lease_without_a_lease_ends_when_nobody_follows_its_task(lease: LeaseDesk, clock: SimClock) -> None:
    lost: list[str] = []
    sub = lease.lend(is_own=True)
    sub.on_loss = lost.append
    with lease.subs.kept(sub), lease.subs.kept(sub):
        clock.sleep(100.0)
        lease.expire()
    clock.sleep(OWN_WINDOW_S - 0.001)
    lease.expire()
    sub.check()
    assert lease.soonest_s() == pytest.approx(0.001)
    clock.sleep(0.001)
    lease.expire()
    assert len(lost) == 1 and "client is gone" in lost[0]
    lease.expire()
    assert len(lost) == 1, "it is lost once"
    assert lease.soonest_s() == float("inf")


def test_the_end_of_a_lease_is_known_in_advance(lease: LeaseDesk, clock: SimClock) -> None:
    """The watch sleeps until then, so that a lapse is noticed within milliseconds."""
    token = lease.acquire("alice").token
    clock.sleep(0.5)
    assert lease.soonest_s() == pytest.approx(TTL_S - 0.5)
    lease.heartbeat(token)
    assert lease.soonest_s() == pytest.approx(TTL_S)


def test_a_jump_of_the_wall_clock_decides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    lease = LeaseDesk(ttl_s=60.0)
    token = lease.acquire("alice").token
    sub, until_s = lease.lend(is_own=True), lease.clock_s() + 9.0
    real = time.time
    for jump_s in (3600.0, -3600.0, 86_400.0 * 365):
        monkeypatch.setattr(time, "time", lambda jump_s=jump_s: real() + jump_s)
        lease.expire()
        assert lease.admit(Command(token=token, until_s=until_s)) == "alice"
        assert lease.heartbeat(token).remaining_s > 59.0
        sub.check()
