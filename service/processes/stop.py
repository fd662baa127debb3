"""The stop process: a small HTTP port that latches the software stop and does nothing else, so nothing delays it.

This is not a safety function: a machine that can hurt people needs a hardware stop.

Anyone may stop, without a key, a lease or a request body. Only the supervisor can reset, over this process's standard
input. When the supervisor ends, the process sets the latch and ends.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
from pathlib import Path

from service.processes.latch import Latch, LatchState

MAX_HEAD_BYTES = 8192
HEAD_TIMEOUT_S = 2.0
REASONS = {200: "OK", 204: "No Content", 400: "Bad Request", 404: "Not Found", 405: "Method Not Allowed"}


class StopServer:
    """Answers `POST /v1/stop` and `GET /v1/stop` in raw HTTP/1.1, one request per connection.

    Args:
        latch: the stop latch; only this object writes it.
        origins: web origins that may read the answers (every origin may stop).
    """

    def __init__(self, latch: Latch, origins: tuple[str, ...] = ()) -> None:
        self._latch = latch
        self._origins = origins

    async def start(self, listener: socket.socket) -> asyncio.Server:
        """Start to serve on a bound socket."""
        return await asyncio.start_server(self._serve, sock=listener, limit=MAX_HEAD_BYTES, backlog=512)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_TIMEOUT_S)
            peer = writer.get_extra_info("peername")
            writer.write(self.answer(head, str(peer[0]) if isinstance(peer, tuple) else "local"))
            await asyncio.wait_for(writer.drain(), HEAD_TIMEOUT_S)
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a slow or broken client gets no answer and does not delay others
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    def answer(self, head: bytes, peer: str) -> bytes:
        """Return the whole response to a request head; a stop is latched before the rest of the request is checked."""
        lines = head.decode("latin-1").split("\r\n")
        method, _, rest = lines[0].partition(" ")
        path = rest.partition(" ")[0].partition("?")[0].rstrip("/")
        headers = {key.strip().lower(): value.strip() for key, _, value in (line.partition(":") for line in lines[1:])}
        origin = headers.get("origin", "")
        if path != "/v1/stop":
            return self._response(404, {"title": "this port serves only /v1/stop", "hint": "use the main port"}, origin)
        if method == "POST":
            state = self._latch.set(f"POST /v1/stop from {peer}")
            return self._response(200, as_dict(state), origin)
        if method == "GET":
            return self._response(200, as_dict(self._latch.state()), origin)
        if method == "OPTIONS":
            return self._response(204, None, origin)
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
        return "\r\n".join([*head, "", ""]).encode("latin-1") + data


def as_dict(state: LatchState) -> dict[str, object]:
    """Return the latch's state as the API shows it."""
    return {
        "is_latched": state.is_latched,
        "count": state.count,
        "changed_time_s": state.time_s,
        "source": state.source,
    }


def obey(latch: Latch, line: str) -> None:
    """Carry out one line from the supervisor: `stop SOURCE` or `reset COUNT SOURCE`."""
    command, _, rest = line.strip().partition(" ")
    if command == "stop":
        latch.set(rest)
    if command == "reset":
        count, _, source = rest.partition(" ")
        latch.reset(source, seen_count=int(count))


async def _run(listener: socket.socket, latch: Latch, origins: tuple[str, ...]) -> None:
    server = await StopServer(latch, origins).start(listener)
    commands = asyncio.StreamReader()
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while line := await commands.readline():
        obey(latch, line.decode("utf-8", "replace"))
    latch.set("the service is gone")
    server.close()


def main() -> None:
    """Run the stop process; this is its entry point."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True, help="bound listening socket")
    parser.add_argument("--latch", type=Path, required=True)
    parser.add_argument("--origin", action="append", default=[])
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor handles Ctrl-C and closes the pipe when it ends
    with contextlib.suppress(OSError):
        os.nice(-10)  # only root may raise the priority; the process works without it
    with Latch(options.latch) as latch, socket.socket(fileno=options.fd) as listener:
        asyncio.run(_run(listener, latch, tuple(options.origin)))


if __name__ == "__main__":
    main()
