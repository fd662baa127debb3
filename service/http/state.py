"""The state that the routers share, and the dependencies that give them access to it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from fastapi import Depends, Header, Request, WebSocket

from service.core import Service
from service.errors import Busy
from service.http.hub import Hub
from service.http.metrics import Metrics
from service.readings import ReadingDesk

T = TypeVar("T")
DEVICE_THREADS = 6
CONTROL_THREADS = 4
MAX_READING = 40


@dataclass(slots=True, kw_only=True, eq=False)
class AppState:
    """The service, and the state of its HTTP interface.

    Attributes:
        stop_url: address of the stop process; shown to clients.
        pool: threads for device reads; when silent devices fill it, further reads are refused.
        control_pool: threads for stop, cancel, reset and starting tasks, which no device read may delay.
    """

    service: Service
    stop_url: str
    hub: Hub
    metrics: Metrics
    readings: ReadingDesk
    started_s: float = field(default_factory=time.monotonic)
    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(DEVICE_THREADS, "device-read"))
    control_pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(CONTROL_THREADS, "control"))
    _reading: int = 0

    async def in_thread(self, work: Callable[[], T]) -> T:
        """Run work that accesses devices or the disk outside the event loop.

        Raises:
            Busy: too many such calls are waiting.
        """
        if self._reading >= MAX_READING:
            raise Busy(f"{self._reading} reads wait already", hint="a device may be silent: see GET /v1/devices")
        self._reading += 1  # only the event loop counts, so no lock is needed
        try:
            return await asyncio.get_running_loop().run_in_executor(self.pool, work)
        finally:
            self._reading -= 1

    async def act(self, work: Callable[[], T]) -> T:
        """Run work that starts, stops, cancels or resets outside the event loop; no device read delays it."""
        return await asyncio.get_running_loop().run_in_executor(self.control_pool, work)


def state_of(request: Request) -> AppState:
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
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", max_length=200, description="the same key with the same request returns the same task"
    ),
]
