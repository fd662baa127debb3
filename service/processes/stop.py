"""The stop process: a small HTTP port that latches the software stop and does nothing else, so nothing delays it.

This is not a safety function: a machine that can hurt people needs a hardware stop.

Anyone may stop, without a key, a lease or a request body. Only the supervisor can reset, over this process's standard
input. When the supervisor ends, the process sets the latch and ends; if the arm then goes back the way it came, the process
stays until that has ended, so that the arm can be stopped. It also sets the latch when the service or the cell gives no
heartbeat.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import socket
import sys
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from hal.priorities import Priority, take_priority
from hal.process_state import MOVES, set_memory_priority
from service.processes.beat import PERIOD_S, SILENCE_S
from service.processes.latch import LATCH, WHEN_LOST, Latch, LatchState, StopLevel
from service.processes.watchdog import Watchdog

MAX_HEAD_BYTES = 65_536  # browsers send the cookies of all pages of this machine, whatever their port
HEAD_TIMEOUT_S = 2.0
WAY_BACK_S = 15.0  # the cell of a service that has ended is gone sooner
RECORD_S = 0.2  # an answer waits no longer for the record of its stop
MAX_CONNECTIONS = 300  # far fewer than the 1024 files that a process may usually open
PATH = "/v1/stop"
GONE = "the service is gone"
REASONS = {
    200: "OK", 204: "No Content", 400: "Bad Request", 403: "Forbidden", 404: "Not Found", 405: "Method Not Allowed",
}  # fmt: skip
LOCAL_NAMES = ("127.0.0.1", "localhost", "::1")


class StopServer:
    """Answers `POST /v1/stop` and `GET /v1/stop` in raw HTTP/1.1, one request per connection.

    A request line is enough to stop, whatever follows it. Only the state of the stop is told, and only to callers that used
    a name of this service: everybody else gets no more than that the stop is latched.

    Args:
        latch: the stop latch; only this object writes it.
        origins: web origins that may read the answers (every origin may stop).
    """

    def __init__(self, latch: Latch, origins: tuple[str, ...] = ()) -> None:
        self._latch = latch
        self._origins = origins
        self._hosts = {*LOCAL_NAMES, *(urlsplit(origin).hostname or "" for origin in origins)}
        self._open: dict[asyncio.StreamWriter, bool] = {}  # whether each connection has stopped; the oldest first

    async def start(self, listener: socket.socket) -> asyncio.Server:
        """Start to serve on a bound socket."""
        return await asyncio.start_server(self._serve, sock=listener, limit=MAX_HEAD_BYTES, backlog=512)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open[writer] = False
        if len(self._open) > MAX_CONNECTIONS:
            self._make_room(writer)
        try:
            async with asyncio.timeout(HEAD_TIMEOUT_S):
                line = await reader.readuntil(b"\n")
            peer = writer.get_extra_info("peername")
            state = self.begin(line, str(peer[0]) if isinstance(peer, tuple) else "local")
            self._open[writer] = state is not None
            answer = self.answer(line + await _rest(reader), state, is_recorded=await self._is_recorded(state))
            writer.write(answer)
            async with asyncio.timeout(HEAD_TIMEOUT_S):
                await writer.drain()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a slow or broken client gets no answer and does not delay others
        except asyncio.CancelledError:
            pass  # the loop ends; `start_server` of Python 3.11 would print a traceback for a task that was cancelled
        finally:
            self._open.pop(writer, None)
            writer.close()
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()

    def _make_room(self, newest: asyncio.StreamWriter) -> None:
        """Close the oldest connection that has not stopped, or else the oldest: it would keep a later stop out."""
        waiting = (one for one, has_stopped in self._open.items() if not has_stopped and one is not newest)
        oldest = next(waiting, next(iter(self._open)))
        del self._open[oldest]  # at once, because many may come before its own task ends
        oldest.transport.abort()

    def begin(self, line: bytes, peer: str) -> LatchState | None:
        """Latch the stop if the request line asks for it; nothing that follows can prevent it."""
        method, path = _asked(line)
        return self._latch.set(f"POST {PATH} from {peer}", _level(line)) if (method, path) == ("POST", PATH) else None

    async def _is_recorded(self, state: LatchState | None) -> bool:
        """Wait a moment until the service has recorded the stop; returns whether it has."""
        if state is None or not self._latch.recorded_count:  # nobody records here
            return False
        loop = asyncio.get_running_loop()
        end_s = loop.time() + RECORD_S
        while self._latch.recorded_count < state.count and loop.time() < end_s:  # noqa: ASYNC110 - in shared memory
            await asyncio.sleep(0.002)
        return self._latch.recorded_count >= state.count

    def answer(self, head: bytes, state: LatchState | None, *, is_recorded: bool = False) -> bytes:
        """Return the whole response to a request head; `state` is that of the stop which it has made."""
        lines = head.decode("latin-1").split("\r\n")
        method, path = _asked(head)
        headers = {key.strip().lower(): value.strip() for key, _, value in (line.partition(":") for line in lines[1:])}
        origin = headers.get("origin", "")
        is_own = _hostname(headers.get("host", LOCAL_NAMES[0])) in self._hosts and origin in ("", *self._origins)
        if path != PATH:
            return self._response(404, {"title": f"this port serves only {PATH}", "hint": "use the main port"}, origin)
        if state is not None:
            told = {**as_dict(state), "is_recorded": is_recorded} if is_own else {"is_latched": True}
            return self._response(200, told, origin)
        if method == "OPTIONS":
            return self._response(204, None, origin)
        if method == "GET" and is_own:
            return self._response(200, as_dict(self._latch.state()), origin)
        if method == "GET":
            return self._response(403, {"title": "no answer for other hosts and pages", "hint": "POST stops"}, origin)
        return self._response(
            405,
            {"title": f"{method[:16]} is not allowed", "hint": "POST latches the stop, GET returns its state"},
            origin,
        )

    def _response(self, status: int, body: object, origin: str) -> bytes:
        data = b"" if body is None else json.dumps(body).encode()
        media = "application/json" if status < 400 else "application/problem+json"
        head = [
            f"HTTP/1.1 {status} {REASONS[status]}",
            f"Content-Type: {media}",
            f"Content-Length: {len(data)}",
            "Cache-Control: no-store",
            "Connection: close",
            "Vary: Origin",
        ]
        if origin in self._origins:
            head += [f"Access-Control-Allow-Origin: {origin}", "Access-Control-Allow-Methods: GET, POST"]
        elif origin and status == 204:  # a page that asks first may stop as well
            head += ["Access-Control-Allow-Origin: *", "Access-Control-Allow-Methods: POST"]
            head += ["Access-Control-Allow-Headers: *"]
        return "\r\n".join([*head, "", ""]).encode("latin-1") + data


async def _rest(reader: asyncio.StreamReader) -> bytes:
    """Return the rest of a head; what is too long or too late is left out."""
    rest, line = b"", b"."
    with contextlib.suppress(TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
        async with asyncio.timeout(HEAD_TIMEOUT_S):
            while line.strip() and len(rest) < MAX_HEAD_BYTES:
                line = await reader.readuntil(b"\n")
                rest += line
    return rest


def _asked(head: bytes) -> tuple[str, str]:
    """Return method and path of a request."""
    method, _, rest = head.partition(b"\n")[0].decode("latin-1").strip().partition(" ")
    return method, rest.partition(" ")[0].partition("?")[0].rstrip("/")


def _level(line: bytes) -> StopLevel:
    """Return the level of a stop; whatever does not ask to hold switches off."""
    target = line.decode("latin-1").strip().partition(" ")[2].partition(" ")[0]
    return level_of(parse_qs(target.partition("?")[2]).get("level", [""])[-1])


def level_of(text: str) -> StopLevel:
    """Return the level that a caller names; a stop is never refused, so that an unknown name switches off."""
    return StopLevel.HOLD if text == StopLevel.HOLD else StopLevel.OFF


def _hostname(host: str) -> str:
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    return name.strip("[]").lower()


def as_dict(state: LatchState) -> dict[str, object]:
    """Return the latch's state as the API shows it."""
    return {
        "is_latched": state.is_latched,
        "count": state.count,
        "changed_time_s": state.time_s,
        "source": state.source,
        "level": str(state.level),
    }


def obey(latch: Latch, line: str) -> None:
    """Carry out one line from the supervisor: `stop SOURCE`, `hold SOURCE` or `reset COUNT SOURCE`."""
    command, _, rest = line.strip().partition(" ")
    if command in ("stop", "hold"):
        latch.set(rest, level_of(command))
    if command == "reset":
        count, _, source = rest.partition(" ")
        latch.reset(source, seen_count=int(count))


async def _run(
    listener: socket.socket, latch: Latch, origins: tuple[str, ...], watchdog: Watchdog, service_lost: StopLevel
) -> None:
    server = await StopServer(latch, origins).start(listener)
    watchdog.look()
    async with watchdog.running():
        commands = asyncio.StreamReader()
        loop = asyncio.get_running_loop()
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        while line := await commands.readline():
            obey(latch, line.decode("utf-8", "replace"))
        if service_lost is StopLevel.RETREAT:
            latch.set(GONE, service_lost)
            await _end_of_way_back(latch)
        latch.set(GONE)
    server.close()


async def _end_of_way_back(latch: Latch) -> None:
    """Return when somebody has stopped the arm, or its cell has ended, which the watchdog notices, or after a bounded time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(WAY_BACK_S):
            while latch.goes_back():  # noqa: ASYNC110 - in shared memory
                await asyncio.sleep(PERIOD_S)


def main() -> None:
    """Run the stop process; this is its entry point."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True, help="bound listening socket")
    parser.add_argument("--folder", type=Path, required=True, help="runtime folder of the service")
    parser.add_argument("--silence", type=float, default=SILENCE_S, help="see Beat.lost")
    parser.add_argument("--service-lost", default="stop", choices=list(WHEN_LOST), help="see the cell file")
    parser.add_argument("--origin", action="append", default=[])
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor handles Ctrl-C and closes the pipe when it ends
    take_priority(Priority.STOP)
    set_memory_priority(MOVES)
    with Latch(options.folder / LATCH) as latch, socket.socket(fileno=options.fd) as listener:
        lost = WHEN_LOST[options.service_lost]
        watchdog = Watchdog(latch, options.folder, silence_s=options.silence, service_lost=lost)
        asyncio.run(_run(listener, latch, tuple(options.origin), watchdog, lost))


if __name__ == "__main__":
    main()
