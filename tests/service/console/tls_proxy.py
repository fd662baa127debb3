"""A proxy that ends TLS, for tests: it passes each connection on by the path of its first request, as it came."""

from __future__ import annotations

import contextlib
import select
import socket
import ssl
import threading
from pathlib import Path

HEAD_END = b"\r\n\r\n"
RECORD_S = 0.02


class TlsProxy:
    """Listens on a free port of this machine.

    Args:
        cert, key: files in PEM format.
    """

    def __init__(self, cert: Path, key: Path) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(cert, key)
        self._context = context
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._service = Path()
        self._console_port = 0

    def start(self, *, service: Path, console_port: int) -> None:
        """Pass `/v1/stop` on to the service's Unix socket, and all else to the console."""
        self._service, self._console_port = service, console_port
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Accept no more connections."""
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                plain, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(plain,), daemon=True).start()

    def _serve(self, plain: socket.socket) -> None:
        with contextlib.suppress(OSError), plain, self._context.wrap_socket(plain, server_side=True) as browser:
            head = b""
            while HEAD_END not in head:
                part = browser.recv(65536)
                if not part:
                    return
                head += part
            with self._backend(head) as backend:
                backend.sendall(_forwarded(head))
                _join(browser, backend)

    def _backend(self, head: bytes) -> socket.socket:
        if head.split(b" ", 2)[1] == b"/v1/stop":
            backend = socket.socket(socket.AF_UNIX)
            backend.connect(str(self._service))
            return backend
        return socket.create_connection(("127.0.0.1", self._console_port))


def _forwarded(head: bytes) -> bytes:
    """Return the request as a proxy passes it on; one that is no WebSocket ends its connection with the answer."""
    lines = head.split(b"\r\n")
    if b"upgrade: websocket" not in head.lower():
        lines = [line for line in lines if not line.lower().startswith(b"connection:")]
        lines.insert(1, b"Connection: close")
    host = next(line.partition(b":")[2].strip() for line in lines if line.lower().startswith(b"host:"))
    lines[1:1] = [b"X-Forwarded-Proto: https", b"X-Forwarded-Host: " + host, b"X-Forwarded-For: 10.1.2.3"]
    return b"\r\n".join(lines)


def _join(browser: ssl.SSLSocket, backend: socket.socket) -> None:
    """Pass bytes on in both directions until one side ends; by one thread, because two may not share a TLS connection."""
    while True:
        ready = [browser] if browser.pending() else select.select([browser, backend], [], [])[0]
        for source in ready:
            browser.settimeout(RECORD_S)
            try:
                part = source.recv(65536)
            except TimeoutError:  # a record of TLS itself, or the beginning of one
                continue
            if not part:
                return
            browser.settimeout(None)
            (backend if source is browser else browser).sendall(part)
