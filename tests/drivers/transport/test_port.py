"""The owner thread of a port sets it up again after each loss."""

from __future__ import annotations

import os
import threading

import psutil
import pytest

from drivers.emulators.ports import PtyPort
from drivers.transport.link import Link, LinkLost
from drivers.transport.port import Port
from drivers.transport.serial_link import open_serial
from tests.drivers.rigs import ScriptLink, later, until


class Tenant:
    """Counts its calls and serves until told to lose the link."""

    def __init__(self) -> None:
        self.set_ups = 0
        self.losses: list[str] = []
        self.lose = threading.Event()

    def set_up(self, link: Link) -> None:
        self.set_ups += 1

    def serve(self, link: Link) -> None:
        if self.lose.is_set():
            self.lose.clear()
            raise LinkLost("gone")
        link.read(later(0.005))

    def lost(self, error: Exception) -> None:
        self.losses.append(str(error))


class Waiter(Tenant):
    """Waits for an answer during set-up for one minute."""

    def __init__(self) -> None:
        super().__init__()
        self.is_waiting = threading.Event()

    def set_up(self, link: Link) -> None:
        self.is_waiting.set()
        link.read(later(60.0))


def test_a_port_is_closed_in_the_middle_of_a_set_up_that_waits() -> None:
    far, tenant = PtyPort("line"), Waiter()
    port = Port("p", open_link=lambda: open_serial(str(far.path), baud=9600, device="p"), tenant=tenant)
    try:
        port.start()
        assert tenant.is_waiting.wait(5.0)
        port.close()
        assert not port._thread.is_alive()
        assert tenant.losses == [], "it was let go, not lost"
    finally:
        far.close()


def test_a_port_repeats_the_set_up_after_each_loss_without_a_leak() -> None:
    far = PtyPort("line")
    tenant = Tenant()
    port = Port("p", open_link=lambda: open_serial(str(far.path), baud=9600, device="p"), tenant=tenant)
    process = psutil.Process()
    try:
        port.start()
        until(lambda: port.link is not None)
        before = (process.num_fds(), threading.active_count())
        for i in range(20):
            tenant.lose.set()
            until(lambda i=i: tenant.set_ups == i + 2)
        until(lambda: port.link is not None)
        assert (process.num_fds(), threading.active_count()) == before
        assert port.reconnects == 20
        assert tenant.losses == ["gone"] * 20
    finally:
        port.close()
        port.close()
        far.close()


@pytest.mark.parametrize("is_allowed", [True, False])
def test_an_owner_thread_asks_for_real_time_and_lives_without(
    is_allowed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        assert (pid, policy) == (0, os.SCHED_RR | os.SCHED_RESET_ON_FORK)
        asked.append((threading.current_thread().name, param.sched_priority))
        if not is_allowed:
            raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    port = Port("p", open_link=ScriptLink, tenant=Tenant(), realtime_priority=7)
    port.start()
    until(lambda: port.link is not None)
    port.close()
    assert asked == [("port p", 7)]
    assert port.is_realtime is is_allowed
