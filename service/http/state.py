"""The state that the routers share, and the dependencies that give them access to it."""

from __future__ import annotations

import asyncio
import contextvars
import functools
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Request, WebSocket

from hal.priorities import Priority, take_priority
from service.access.sessions import Sessions
from service.core import Service
from service.errors import Busy
from service.http.hub import Hub
from service.http.metrics import Metrics
from service.processes.client_host import CONSOLE_HEADER
from service.readings import ReadingDesk
from service.tasks.lease import Command

T = TypeVar("T")
DEVICE_THREADS = 6
CONTROL_THREADS = 4
STOP_THREADS = 2
MAX_READING = 40


@dataclass(slots=True, kw_only=True, eq=False)
class AppState:
    """The service, and the state of its HTTP interface.

    Attributes:
        stop_url: address of the stop process; shown to clients.
        origins: web origins of this service's own pages, which alone may use a session.
        cookie: name of the session's cookie, which differs between services of one machine.
        sessions: the browsers that have logged in.
        console_url: address of the console; None without one.
        console_secret: by which a request of the console is recognised; None without one.
        pool: threads for device reads; when silent devices fill it, further reads are refused.
        control_pool: threads for cancel, reset and starting tasks, which no device read may delay.
        stop_pool: threads for nothing but stops, which no reset that waits may delay.
    """

    service: Service
    stop_url: str
    hub: Hub
    metrics: Metrics
    readings: ReadingDesk
    origins: frozenset[str] = frozenset()
    cookie: str = "panelwright"
    sessions: Sessions = field(default_factory=Sessions)
    console_url: str | None = None
    console_secret: str | None = None
    started_s: float = field(default_factory=time.monotonic)
    pool: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(DEVICE_THREADS, "device-read", take_priority, (Priority.WORK,))
    )
    control_pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(CONTROL_THREADS, "control"))
    stop_pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(STOP_THREADS, "stop"))
    _reading: int = 0

    def is_of_console(self, request: Request) -> bool:
        """Return whether the console sent a request."""
        given = request.headers.get(CONSOLE_HEADER, "")
        return self.console_secret is not None and secrets.compare_digest(given.encode(), self.console_secret.encode())

    async def in_thread(self, work: Callable[[], T]) -> T:
        """Run work that accesses devices or the disk outside the event loop.

        Raises:
            Busy: too many such calls are waiting.
        """
        if self._reading >= MAX_READING:
            raise Busy(f"{self._reading} reads wait already", hint="a device may be silent: see GET /v1/devices")
        self._reading += 1  # only the event loop counts, so no lock is needed
        try:
            return await asyncio.get_running_loop().run_in_executor(self.pool, _in_this_context(work))
        finally:
            self._reading -= 1

    async def act(self, work: Callable[[], T]) -> T:
        """Run work that starts, cancels or resets outside the event loop; no device read delays it."""
        return await asyncio.get_running_loop().run_in_executor(self.control_pool, _in_this_context(work))

    async def commit(self, kind: str, data: dict[str, Any]) -> None:
        """Record a change durably before it is acknowledged.

        Raises:
            JournalError: it could not be written; the change itself is in effect.
        """
        await self.act(functools.partial(self.service.commit, kind, data))

    async def stop(self, work: Callable[[], T]) -> T:
        """Run work that stops outside the event loop; only other stops may delay it, and its caller cannot cancel it."""
        return await asyncio.shield(asyncio.get_running_loop().run_in_executor(self.stop_pool, _in_this_context(work)))


def _in_this_context(work: Callable[[], T]) -> Callable[[], T]:
    """Return `work` to be run by another thread in the name of the key that acts here."""
    context = contextvars.copy_context()
    return lambda: context.run(work)


async def state_of(request: Request) -> AppState:
    """Return the application's state, for routes."""
    state: AppState = request.app.state.panelwright
    return state


def socket_state(socket: WebSocket) -> AppState:
    """Return the application's state, for WebSockets."""
    state: AppState = socket.app.state.panelwright
    return state


State = Annotated[AppState, Depends(state_of)]
LeaseToken = Annotated[
    str | None,
    Header(
        alias="Lease-Token", max_length=200, description="token from POST /v1/lease; needed while the lease is held"
    ),
]
Sequence = Annotated[
    int | None,
    Header(
        alias="Lease-Sequence",
        ge=0,
        lt=2**63,
        description="number of this command; under one lease the numbers must rise, and once there is one, all need one",
    ),
]
Until = Annotated[
    float | None,
    Header(
        alias="Command-Until",
        allow_inf_nan=False,
        description="begin before this time of the service's clock (`clock_s` of GET /v1/lease), at most 10 s away, or never",
    ),
]


async def command_of(lease_token: LeaseToken = None, sequence: Sequence = None, until_s: Until = None) -> Command:
    """Return what comes with a command in its headers."""
    return Command(token=lease_token, sequence=sequence, until_s=until_s)


async def admit(state: State, command: Annotated[Command, Depends(command_of)]) -> str | None:
    """Ask the lease whether a request may change something; returns the holder's name, or None when nobody holds it.

    Raises:
        LeaseError: another client holds the lease, or the command is old or came too late.
    """
    return state.service.lease.admit(command)


WithCommand = Annotated[Command, Depends(command_of)]
Admitted = Annotated[str | None, Depends(admit)]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", max_length=200, description="the same key with the same request returns the same task"
    ),
]
