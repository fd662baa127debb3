"""The lease has one holder and a rising epoch, and no motion is allowed with an old epoch."""

from __future__ import annotations

import time
from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from hal.clock import SimClock
from hal.errors import LeaseError
from service.errors import JournalError, StaleEpoch
from service.tasks.lease import Grant, LeaseDesk
from service.tasks.sub_leases import SubLeases

TTL_S = 2.0


def desk() -> tuple[LeaseDesk, SimClock, list[str]]:
    clock, losses = SimClock(), list[str]()
    return LeaseDesk(ttl_s=TTL_S, clock=clock, on_loss=losses.append), clock, losses


def test_one_holder_at_a_time() -> None:
    lease, _, _ = desk()
    lease.acquire("alice")
    with pytest.raises(LeaseError) as caught:
        lease.acquire("bob")
    assert caught.value.details["holder"] == "alice"


def test_without_a_lease_everybody_may_move_and_with_one_only_the_holder() -> None:
    lease, _, _ = desk()
    assert lease.check(None) is None
    grant = lease.acquire("alice")
    assert lease.check(grant.token) == "alice"
    with pytest.raises(LeaseError):
        lease.check(None)
    with pytest.raises(StaleEpoch):
        lease.check("1.guess")


def test_a_token_without_a_lease_is_stale() -> None:
    lease, _, _ = desk()
    grant = lease.acquire("alice")
    lease.release(grant.token)
    with pytest.raises(StaleEpoch):
        lease.check(grant.token)


def test_an_empty_token_is_nobodys() -> None:
    lease, _, _ = desk()
    for use in (lease.check, lease.heartbeat, lease.release):
        with pytest.raises(StaleEpoch):
            use("")


def test_heartbeats_keep_it_and_silence_ends_it() -> None:
    lease, clock, losses = desk()
    grant = lease.acquire("alice")
    for _ in range(5):
        clock.sleep(0.9 * TTL_S)
        assert lease.heartbeat(grant.token).remaining_s == pytest.approx(TTL_S)
    clock.sleep(TTL_S)
    lease.expire()
    assert losses == ["the lease of alice lapsed: no heartbeat for 2 s"]
    with pytest.raises(StaleEpoch):
        lease.heartbeat(grant.token)


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0])
def test_a_wall_clock_that_is_set_by_an_hour_ends_no_lease_and_prolongs_none(
    monkeypatch: pytest.MonkeyPatch, jump_s: float
) -> None:
    clocks = {"time": 1.8e9, "monotonic": 5000.0}
    monkeypatch.setattr(time, "time", lambda: clocks["time"])
    monkeypatch.setattr(time, "monotonic", lambda: clocks["monotonic"])
    lease = LeaseDesk(ttl_s=TTL_S)  # on the clock of the machine
    grant = lease.acquire("alice")
    clocks["time"] += jump_s
    clocks["monotonic"] += 0.9 * TTL_S
    assert lease.heartbeat(grant.token).remaining_s == pytest.approx(TTL_S)
    clocks["monotonic"] += TTL_S
    with pytest.raises(StaleEpoch):
        lease.heartbeat(grant.token)


def test_a_take_over_tells_what_was_lost() -> None:
    lease, _, losses = desk()
    old = lease.acquire("alice")
    new = lease.take_over("bob")
    assert new.epoch == old.epoch + 1
    assert losses == ["bob took the lease over from alice"]
    with pytest.raises(StaleEpoch):
        lease.check(old.token)


def test_what_has_lapsed_is_not_taken_over_but_lost_before() -> None:
    lease, clock, losses = desk()
    lease.acquire("alice")
    clock.sleep(TTL_S)
    lease.take_over("bob")
    assert losses == ["the lease of alice lapsed: no heartbeat for 2 s"]


def test_holder_epoch_and_what_is_left_are_told() -> None:
    lease, clock, _ = desk()
    assert lease.holder() == (None, 0, 0.0)
    lease.acquire("alice")
    clock.sleep(0.5)
    assert lease.holder() == ("alice", 1, pytest.approx(TTL_S - 0.5))
    assert lease.heartbeat(lease.take_over("bob").token).epoch == lease.holder()[1] == 2


def test_every_grant_and_its_end_are_reported_with_the_epoch() -> None:
    told: list[tuple[str, dict[str, Any]]] = []
    clock = SimClock()
    lease = LeaseDesk(
        ttl_s=TTL_S, clock=clock, report=lambda *row: told.append(row), commit=lambda *row: told.append(row)
    )
    lease.acquire("alice")
    lease.release(lease.take_over("bob").token)
    lease.acquire("carol")
    clock.sleep(TTL_S)
    lease.acquire("dave")
    assert told == [
        ("lease-acquired", {"holder": "alice", "before": None, "epoch": 1}),
        ("lease-taken-over", {"holder": "bob", "before": "alice", "epoch": 2}),
        ("lease-released", {"holder": "bob", "epoch": 2}),
        ("lease-acquired", {"holder": "carol", "before": None, "epoch": 3}),
        ("lease-lapsed", {"holder": "carol", "epoch": 3}),
        ("lease-acquired", {"holder": "dave", "before": None, "epoch": 4}),
    ]


def test_nothing_is_granted_or_given_back_without_a_record() -> None:
    is_full = [True]

    def commit(_kind: str, _data: dict[str, Any]) -> None:
        if is_full[0]:
            raise JournalError("the disk is full", hint="free space")

    lease = LeaseDesk(ttl_s=TTL_S, clock=SimClock(), commit=commit)
    with pytest.raises(JournalError):
        lease.acquire("alice")
    assert lease.holder() == (None, 0, 0.0)
    is_full[0] = False
    token = lease.acquire("alice").token
    is_full[0] = True
    for refused in (lambda: lease.take_over("bob"), lambda: lease.release(token)):
        with pytest.raises(JournalError):
            refused()
    assert lease.holder() == ("alice", 1, TTL_S)


def test_while_another_ones_task_moves_the_lease_is_not_free_but_can_be_taken_over() -> None:
    moving = {"alice": None, "bob": "missions (task 7) of a client without a lease is running"}
    losses = list[str]()
    lease = LeaseDesk(ttl_s=TTL_S, clock=SimClock(), on_loss=losses.append, others=moving.get)
    with pytest.raises(LeaseError, match=r"nobody holds the cell, but missions \(task 7\)") as caught:
        lease.acquire("bob")
    assert "take-over" in caught.value.hint
    assert lease.holder() == (None, 0, 0.0)
    lease.release(lease.acquire("alice").token)
    assert not losses
    lease.take_over("bob")
    assert losses == ["bob took the lease over"]


def test_a_release_is_no_loss() -> None:
    lease, _, losses = desk()
    lease.release(lease.acquire("alice").token)
    assert not losses


def test_tokens_with_odd_letters_are_refused_not_crashed_on() -> None:
    lease, _, _ = desk()
    lease.acquire("alice")
    with pytest.raises(StaleEpoch):
        lease.check("ü☃")


class LeaseLife(RuleBasedStateMachine):
    """Calls and pauses in any order, compared with a model of who holds the lease until when."""

    def __init__(self) -> None:
        super().__init__()
        self.desk, self.clock, _ = desk()
        self.holder: str | None = None
        self.ends_s = 0.0
        self.grants: list[Grant] = []

    def _held(self) -> bool:
        return self.holder is not None and self.clock.now_s() < self.ends_s

    def _granted(self, grant: Grant) -> None:
        assert all(grant.epoch > earlier.epoch for earlier in self.grants)
        self.grants.append(grant)
        self.holder, self.ends_s = grant.holder, self.clock.now_s() + TTL_S

    @rule(name=st.sampled_from(["alice", "bob"]))
    def acquire(self, name: str) -> None:
        if self._held():
            with pytest.raises(LeaseError):
                self.desk.acquire(name)
        else:
            self._granted(self.desk.acquire(name))

    @rule(name=st.sampled_from(["alice", "bob"]))
    def take_over(self, name: str) -> None:
        self._granted(self.desk.take_over(name))

    @rule(pick=st.integers(0, 10), what=st.sampled_from(["heartbeat", "release", "check"]))
    def use(self, pick: int, what: str) -> None:
        if not self.grants:
            return
        grant = self.grants[-1 - pick % len(self.grants)]
        call: Any = getattr(self.desk, what)
        if grant is not self.grants[-1] or not self._held():
            with pytest.raises(StaleEpoch):
                call(grant.token)
            return
        call(grant.token)
        if what == "heartbeat":
            self.ends_s = self.clock.now_s() + TTL_S
        if what == "release":
            self.holder = None

    @rule(seconds=st.floats(0.0, 3.0))
    def silence(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    @invariant()
    def agrees_with_the_model(self) -> None:
        holder, _, left_s = self.desk.holder()
        assert holder == (self.holder if self._held() else None)
        assert (left_s > 0.0) == (holder is not None)


TestLeaseLife = LeaseLife.TestCase


def test_a_motion_of_the_console_is_kept_while_that_is_started_again_and_ends_without_it() -> None:
    clock, lost = SimClock(), list[str]()
    subs = SubLeases(clock)
    console, other = subs.lend(1, is_own=True), subs.lend(1, is_own=True)
    console.is_of_console = True
    console.on_loss, other.on_loss = (lambda _reason: lost.append("console")), (lambda _reason: lost.append("other"))
    with subs.kept_of_console():
        clock.sleep(5 * subs.window_s)
        subs.expire()
        assert lost == ["other"], "the console may take long to start, and another client has nothing to do with it"
    clock.sleep(0.9 * subs.window_s)
    subs.expire()
    assert lost == ["other"]
    clock.sleep(0.2 * subs.window_s)
    subs.expire()
    assert lost == ["other", "console"]
