"""Runs the application with uvicorn, in the main thread or in another one, and ends it in bounded time."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import uvicorn
from starlette.types import ASGIApp

from hal.priorities import Priority, RealtimeUnlessBusy, take_priority
from service.http.load import Load, limited_protocol

GRACE_S = 2


class _Server(uvicorn.Server):
    """A uvicorn server that reports signals, because it would wait for open streams unless they are ended."""

    def __init__(self, config: uvicorn.Config, on_exit: Callable[[str], None]) -> None:
        super().__init__(config)
        self._on_exit = on_exit
        self._realtime: RealtimeUnlessBusy | None = None

    async def on_tick(self, counter: int) -> bool:
        """Review the priority of the event loop; uvicorn calls this ten times a second."""
        if self._realtime is None:
            self._realtime = RealtimeUnlessBusy()
        self._realtime.review()
        return await super().on_tick(counter)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle the first SIGINT or SIGTERM; called by uvicorn, which would cut off all answers at a second one."""
        if self.should_exit:
            return
        self._on_exit("Ctrl-C" if sig == 2 else f"signal {sig}")
        super().handle_exit(sig, frame)


class HttpServer:
    """An HTTP server on bound sockets.

    Args:
        load: limits of the connections; the same as of the application's guard.
        tls: files with certificate and key; None for plain HTTP.
        on_exit: called first when a signal or `stop` ends the server; stops the arm and ends the streams.
    """

    def __init__(
        self,
        app: ASGIApp,
        listeners: list[socket.socket],
        *,
        load: Load,
        on_exit: Callable[[str], None],
        tls: tuple[Path, Path] | None = None,
    ) -> None:
        config = uvicorn.Config(
            app,
            http=limited_protocol(load),
            log_level="warning",
            access_log=False,
            loop="asyncio",  # not what happens to be installed
            server_header=False,
            timeout_graceful_shutdown=GRACE_S,
            timeout_keep_alive=10,
            h11_max_incomplete_event_size=65_536,
            ws_max_size=65_536,
            ws_per_message_deflate=False,  # compressing each sample for each listener takes longer than sending it
            proxy_headers=False,  # the guard reads them, and only those of a proxy that is named
            ssl_certfile=tls[0] if tls is not None else None,
            ssl_keyfile=tls[1] if tls is not None else None,
        )
        self._listeners = listeners
        self._on_exit = on_exit
        self._server = _Server(config, on_exit)
        self._thread: threading.Thread | None = None

    @property
    def is_up(self) -> bool:
        """Whether the server answers requests."""
        return bool(self._server.started)

    def run(self) -> None:
        """Serve in this thread, which must be the main thread, until a signal or `stop`."""
        take_priority(Priority.ANSWERS)
        self._server.run(sockets=self._listeners)

    def start(self) -> None:
        """Serve in a thread of its own."""
        thread = threading.Thread(target=self.run, name="http", daemon=True)
        thread.start()
        self._thread = thread  # only now, because another thread may call `stop`, which joins it
        pause = threading.Event()
        while not self._server.started and thread.is_alive():
            pause.wait(0.01)

    def stop(self) -> None:
        """End the server, from any thread; a second call does nothing."""
        if not self._server.should_exit:
            self._on_exit("the server ends")
            self._server.should_exit = True
        if self._thread is not None:
            self._thread.join(GRACE_S + 3.0)
