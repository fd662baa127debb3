"""Runs service, HTTP server and stop port together, for `panelwright serve` and `panelwright demo`."""

from __future__ import annotations

import logging
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from pydantic.warnings import UnsupportedFieldAttributeWarning

from hal.config import Cell
from hal.errors import CellError, ConfigError
from hal.gc_freeze import freeze_loaded
from hal.malloc_arenas import share_one_heap
from hal.priorities import raise_session
from hal.process_state import COMPUTES, set_memory_priority
from service.client import Client
from service.commissioning.outlets import checked_outlets
from service.core import Service, book_of
from service.exposure import Exposure, unix_socket
from service.operations import Operation
from service.processes.client_host import GATEWAY, OUTLETS, OUTLETS_KEY, ClientHost, ConsoleHost
from service.processes.stop_host import bound_socket

if TYPE_CHECKING:
    from service.http.server import HttpServer
    from service.processes.cell import CellRuntime

log = logging.getLogger(__name__)
SWITCH_S = 0.00005  # Python's default is 5 ms; a computing thread yields sooner to one that answers or stores


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Options of `serve`.

    Attributes:
        stop_port: None for the port after `port`, or for any free port.
        partial: whether to go on without devices that do not connect.
        warm: whether to load the compiled kernels at the start.
        record: file to record everything in.
        replay: starts a recorded cell in place of the devices; needs `inline`.
        exposure: where it listens, and how strangers are kept out.
        console: whether to start the console, a process of its own that is a client of the HTTP API.
        console_port: None for the second port after `port`, or for any free one where that is taken.
    """

    exposure: Exposure = field(default_factory=Exposure)
    port: int = 8460
    stop_port: int | None = None
    runs_dir: Path = Path("runs")
    inline: bool = False
    partial: bool = False
    warm: bool = True
    record: Path | None = None
    replay: Callable[[], CellRuntime] | None = None
    console: bool = False
    console_port: int | None = None


class Panelwright:
    """Starts and closes everything that `serve` runs.

    Attributes:
        is_loaded: set when the modules that compute are imported; requests that may need them wait for that.

    Raises:
        ConfigError: a port is in use, or given twice, or strangers could use the service.
        KeysUnusable: the file of keys cannot be used.
    """

    def __init__(self, cell: Cell, options: Options, *, operations: Mapping[str, Operation] | None = None) -> None:
        if options.port and options.port == options.stop_port:
            raise ConfigError(
                f"port {options.port} cannot serve the API and the stop process",
                hint="leave --stop-port out, or give it another number",
            )
        exposure = self._exposure = options.exposure
        exposure.check(book_of(options.runs_dir))
        listener = bound_socket(exposure.host, options.port)
        self.port: int = listener.getsockname()[1]
        stop_port = options.stop_port if options.stop_port is not None else (options.port and self.port + 1)
        try:
            stop_listener = bound_socket(exposure.stop_host, stop_port, option="--stop-port")
            for_proxy = [] if exposure.unix_socket is None else [unix_socket(exposure.unix_socket)]
        except CellError:
            listener.close()
            raise
        self.stop_port: int = stop_listener.getsockname()[1]
        self._error: CellError | None = None
        self._is_settled = threading.Event()
        self._is_ending = threading.Event()
        self.is_loaded = threading.Event()
        self._wants_warmth = options.warm and not options.inline
        if not self._wants_warmth:
            self.is_loaded.set()
        self._server: HttpServer | None = None
        self._listeners = [listener, *for_proxy]
        self._hosts, self._origins = exposure.names_at(self.port)
        console = _console_listener(options, self.port) if options.console else None
        readers = self._origins  # of the stop port's answers
        if console is not None:
            readers |= exposure.names_at(console.getsockname()[1])[1]
        self.service = Service(
            cell,
            _shipped() if operations is None else operations,
            runs_dir=options.runs_dir,
            stop_listener=stop_listener,
            origins=tuple(sorted(readers)),
            inline=options.inline,
            partial=options.partial,
            record=options.record,
            replay=options.replay,
        )
        self.console: ConsoleHost | None = None
        if console is not None:
            self.console = ConsoleHost(
                console,
                service_url=self.url,
                stop_port=self.stop_port,
                cookie=self._cookie,
                report=self.service.note,
                keep=self.service.lease.subs.kept_of_console,
                exposure=exposure.of_console(),
            )

        self.gateway = self._gateway_host(cell, options)

    @property
    def url(self) -> str:
        """Address of the HTTP server."""
        return self._exposure.url(self.port)

    @property
    def _cookie(self) -> str:
        """Name of the cookie of a browser's session, which differs between services of one machine."""
        return f"panelwright_{self.port}"

    @property
    def stop_url(self) -> str:
        """Address of the stop process."""
        return f"http://{self._exposure.stop_host}:{self.stop_port}/v1/stop"

    def client(self, *, timeout_s: float = 40.0) -> Client:
        """Return a client of this service in this process, with a key of its own where keys are needed."""
        return Client(url=self.url, timeout_s=timeout_s, key=self.service.keys.own(), is_lasting=False)

    @property
    def console_url(self) -> str | None:
        """Address of the console; None without one."""
        return None if self.console is None else self._exposure.url(self.console.port)

    @property
    def error(self) -> CellError | None:
        """The error with which the cell could not start, or None."""
        return self._error

    @property
    def is_ending(self) -> bool:
        """Whether it was told to end, perhaps before the start was complete."""
        return self._is_ending.is_set()

    def start(self) -> None:
        """Start the server in a thread and the cell, and wait until both are ready.

        Raises:
            CellError: the cell could not start; everything is closed again.
        """
        self._begin()
        assert self._server is not None  # noqa: S101 - narrowing: `_begin` made it
        self._server.start()
        self._is_settled.wait()
        if self._error is not None:
            self.close()
            raise self._error

    def run(self) -> None:
        """Serve in the main thread until Ctrl-C or SIGTERM, then close.

        The HTTP server is ready before the hardware. A cell that cannot start, for example because its file is wrong, ends
        the server.

        Raises:
            CellError: the cell could not start.
        """
        share_one_heap()
        exit_on_sigterm()
        set_memory_priority(
            COMPUTES
        )  # perception may fill the memory; the cell and the stop process must not pay for it
        try:
            self._begin()
            assert self._server is not None  # noqa: S101 - narrowing: `_begin` made it
            self._server.run()
        finally:
            _ignore_signals()  # a second Ctrl-C must not cut off the end, which takes a bounded time
            self.close()
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Stop the arm, end server and processes; takes a bounded time and is idempotent."""
        self._is_ending.set()
        if self.console is not None:
            self.console.close()
        if self.gateway is not None:
            self.gateway.close()
        if self._server is not None:
            self._server.stop()
        self.service.close()
        for listener in self._listeners:
            listener.close()
        if self._exposure.unix_socket is not None:
            self._exposure.unix_socket.unlink(missing_ok=True)

    def wait_until_settled(self, timeout_s: float) -> bool:
        """Wait until the cell is ready or has failed; returns whether that happened in time."""
        return self._is_settled.wait(timeout_s)

    def _begin(self) -> None:
        """Start the cell in the background, because it takes seconds in which this process imports its web framework."""
        sys.setswitchinterval(SWITCH_S)
        raise_session()
        # FastAPI hides this warning with `catch_warnings`, which imports in the cell's thread can undo meanwhile.
        warnings.simplefilter("ignore", UnsupportedFieldAttributeWarning)
        threading.Thread(target=self._start_service, name="start-cell", daemon=True).start()
        from service.http.app import create_app, load_of_app, state_of_app
        from service.http.guard import Allowed
        from service.http.server import HttpServer

        exposure = self._exposure
        allowed = Allowed(hosts=self._hosts, origins=self._origins, proxies=exposure.proxied_from())
        # The stop port is on this machine only, so that other machines are told the address of the API, with a path.
        stop_url = self.stop_url if exposure.is_local else "/v1/stop"
        app = create_app(
            self.service,
            allowed=allowed,
            stop_url=stop_url,
            cookie=self._cookie,
            console_url=self.console_url,
            console_secret=None if self.console is None else self.console.secret,
            is_loaded=self.is_loaded.is_set,
        )

        def on_exit(why: str) -> None:
            # Latch the stop first, through the stop process; then tell every stream to end.
            self._is_ending.set()
            self.service.stop_quietly(why)
            state_of_app(app).hub.close()
            load_of_app(app).end()

        tls = (exposure.tls_cert, exposure.tls_key) if exposure.tls_cert and exposure.tls_key else None
        self._server = HttpServer(app, self._listeners, load=load_of_app(app), on_exit=on_exit, tls=tls)
        freeze_loaded()
        if self._error is not None:
            self._server.stop()  # the cell failed before there was a server to end
        if self._wants_warmth:
            threading.Thread(target=self._warm, name="warm", daemon=True).start()

    def _gateway_host(self, cell: Cell, options: Options) -> ClientHost | None:
        """Return the process of the outlets; None if the cell file asks for none."""
        if cell.file.outlets.is_empty:
            return None
        outlets = checked_outlets(cell.file.outlets, cell.path.parent, source=str(cell.path))
        cert = self._exposure.tls_cert
        arguments = ["--service", self.url, "--cell", cell.name]
        arguments += ["--folder", str((options.runs_dir / ".service" / "outlets").absolute())]
        arguments += [] if cert is None else ["--ca", str(Path(cert).absolute())]
        environment = {OUTLETS: outlets.model_dump_json(), OUTLETS_KEY: self.service.keys.for_gateway()}
        return ClientHost(GATEWAY, arguments, name="gateway", report=self.service.note, environment=environment)

    def _start_service(self) -> None:
        try:
            self.service.start()
        except CellError as error:
            self._error = None if self._is_ending.is_set() else error  # Ctrl-C during the start is not an error
        except Exception as error:  # a defect must end the program with a message
            log.exception("starting the cell")
            from service.errors import Defect

            self._error = Defect(f"the cell could not start: {error}", hint="the log has the traceback; report it")
        self._is_settled.set()
        if self._error is None and self.console is not None:
            self.console.start()  # after the cell, with which it would share the processor
        if self._error is None and self.gateway is not None:
            self.gateway.start()
        if self._error is not None and self._server is not None:
            self._server.stop()

    def _warm(self) -> None:
        """Load the modules that compute, then the compiled kernels, after the cell's start, which needs the processor more.

        What computes waits for the modules; see `service.http.guard`. An error is logged and shows again when they are used.
        """
        self._is_settled.wait()
        from service.warm import load_modules, warm

        try:
            load_modules()
            self.is_loaded.set()
            warm()
        except Exception:  # raised again, with its context, at the first use
            log.warning("warming up failed", exc_info=True)
        self.is_loaded.set()
        freeze_loaded()


def _console_listener(options: Options, port: int) -> socket.socket:
    """Return the console's bound socket; a port that nobody asked for by number may be any free one."""
    if options.console_port is not None:
        return bound_socket(options.exposure.host, options.console_port, option="--console-port")
    try:
        return bound_socket(options.exposure.host, options.port and port + 2)
    except CellError:
        return bound_socket(options.exposure.host, 0)


def exit_on_sigterm() -> None:
    """Make SIGTERM raise an exception as Ctrl-C does, because its default action would skip all clean-up.

    This also covers uvicorn, which raises the signal again. The end of the terminal (SIGHUP) is handled in the same way,
    unless `nohup` made the process ignore it.
    """

    def leave(_signal: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + signal.SIGTERM)

    signal.signal(signal.SIGTERM, leave)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda _signal, _frame: signal.raise_signal(signal.SIGTERM))


def _shipped() -> Mapping[str, Operation]:
    from service.operations import OPERATIONS

    return OPERATIONS


def _ignore_signals() -> None:
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)
