"""What the routers share, and how they get at it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from fastapi import Depends, Header, Request, WebSocket

from service.core import Service
from service.http.hub import Hub
from service.http.metrics import Metrics
from service.http.readings import ReadingDesk

T = TypeVar("T")
DEVICE_THREADS = 6


@dataclass(slots=True, kw_only=True, eq=False)
class AppState:
    """The service and what only its front needs.

    Attributes:
        stop_url: where the stop process listens; shown to clients.
        pool: threads for device reads, few and apart from the server's, so that slow devices fill no other queue.
    """

    service: Service
    stop_url: str
    hub: Hub
    metrics: Metrics
    readings: ReadingDesk
    started_s: float = field(default_factory=time.monotonic)
    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(DEVICE_THREADS, "device-read"))

    async def in_thread(self, work: Callable[[], T]) -> T:
        """Run blocking work outside the event loop."""
        return await asyncio.get_running_loop().run_in_executor(self.pool, work)


def state_of(request: Request) -> AppState:
    """The app's state, for routes."""
    state: AppState = request.app.state.panelwright
    return state


def socket_state(socket: WebSocket) -> AppState:
    """The app's state, for WebSockets."""
    state: AppState = socket.app.state.panelwright
    return state


State = Annotated[AppState, Depends(state_of)]
LeaseToken = Annotated[
    str | None,
    Header(
        alias="Lease-Token", max_length=200, description="token from POST /v1/lease; needed while somebody holds it"
    ),
]
IdempotencyKey = Annotated[
    str | None,
    Header(alias="Idempotency-Key", max_length=200, description="the same key and request give the same task again"),
]
