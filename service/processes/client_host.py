"""Runs console and gateway for the service, each in a process of its own, and starts them again when they end."""

from __future__ import annotations

import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Any

from service.processes.child import Child

CONSOLE = "service.console.process"  # named and not imported: the web framework stays out of this process
GATEWAY = "service.outlets.process"
OUTLETS, OUTLETS_KEY = "PANELWRIGHT_OUTLETS", "PANELWRIGHT_OUTLETS_KEY"  # environment of the gateway
CONSOLE_PROOF = "PANELWRIGHT_CONSOLE_PROOF"  # environment of the console
CONSOLE_HEADER = "Panelwright-Console"  # carries it in each request of the console
SETTLED_S = 20.0  # a process that lived so long is started again at once
LONGEST_PAUSE_S = 30.0
BRIDGE_S = 60.0  # so long does a motion wait for a console that does not come back
log = logging.getLogger(__name__)


class ClientHost:
    """The process of a client of the service. It may die or be killed at any time: it is started again.

    Args:
        module: what to run, with `arguments` and `environment`.
        name: in the journal.
        report: where unexpected ends are recorded.
        pass_fds: file descriptors that it inherits.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        *,
        name: str,
        report: Callable[[str, dict[str, Any]], None],
        pass_fds: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._module, self._arguments, self._name = module, arguments, name
        self._pass_fds, self._environment = pass_fds, environment
        self._report = report
        self._lock = threading.Lock()
        self._is_closing = threading.Event()
        self._is_ready = threading.Event()
        self._child: Child | None = None
        self._pause_s = 0.0
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """Id of the process; None while there is none."""
        child = self._child
        return child.pid if child is not None and child.is_alive() else None

    def start(self) -> None:
        """Start the process; it answers a few seconds later."""
        with self._lock:
            if self._is_closing.is_set():
                return
            self._child = Child(
                self._module,
                self._arguments,
                pass_fds=self._pass_fds,
                environment=self._environment,
                on_line=lambda _line: self._answers(),
                on_exit=self._exited,
            )

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Wait until the newest process answers; returns whether it did in time."""
        return self._is_ready.wait(timeout_s)

    def close(self) -> None:
        """End the process; a second call does nothing."""
        with self._lock:
            self._is_closing.set()
            child = self._child
        if child is not None:
            child.end(grace_s=1.0)

    def _answers(self) -> None:
        self._is_ready.set()

    def _exited(self, code: int) -> None:
        self._is_ready.clear()
        child = self._child
        if self._is_closing.is_set() or child is None:
            return
        log.warning("the %s ended with code %d; it is started again", self._name, code)
        self._report(f"{self._name}-process-down", {"code": code})
        lived_s = time.monotonic() - child.started_s
        self._pause_s = 0.0 if lived_s > SETTLED_S else min(max(0.5, 2.0 * self._pause_s), LONGEST_PAUSE_S)
        child.kill()
        if not self._is_closing.wait(self._pause_s):
            self.restarts += 1
            self.start()


class ConsoleHost(ClientHost):
    """The console's process, which keeps nothing.

    Args:
        listener: bound socket of the console, which stays open between two processes, so that browsers wait.
        service_url: address of the HTTP API.
        stop_port: port of the stop process.
        cookie: name of the cookie in which the service keeps a session.
        keep: keeps the motions that the console began, while it is started again.
        exposure: further arguments of the process, which say how browsers reach it.
        report, module: see `ClientHost`.

    Attributes:
        secret: by which the service recognises requests of the console; it gives no right.
    """

    def __init__(
        self,
        listener: socket.socket,
        *,
        service_url: str,
        stop_port: int,
        cookie: str,
        report: Callable[[str, dict[str, Any]], None],
        keep: Callable[[], AbstractContextManager[None]] = nullcontext,
        exposure: Sequence[str] = (),
        module: str = CONSOLE,
    ) -> None:
        fd = listener.fileno()
        self.secret = secrets.token_urlsafe(32)
        arguments = ["--fd", str(fd), "--service", service_url, "--stop-port", str(stop_port), "--cookie", cookie]
        arguments += exposure
        environment = {CONSOLE_PROOF: self.secret}
        super().__init__(module, arguments, name="console", report=report, pass_fds=[fd], environment=environment)
        self._listener = listener
        self._keep = keep
        self._bridge = ExitStack()
        self.port: int = listener.getsockname()[1]

    def close(self) -> None:
        """End the process and close its port; a second call does nothing."""
        super().close()
        self._let_go()
        self._listener.close()

    def _answers(self) -> None:
        super()._answers()
        self._let_go()

    def _hold_on(self) -> None:
        """Keep the motions that run, for a bounded time."""
        self._let_go()
        bridge = ExitStack()
        bridge.enter_context(self._keep())
        self._bridge = bridge
        timer = threading.Timer(BRIDGE_S, bridge.close)
        timer.daemon = True
        timer.start()

    def _let_go(self) -> None:
        self._bridge.close()

    def _exited(self, code: int) -> None:
        if not self._is_closing.is_set():
            self._hold_on()
        super()._exited(code)
