"""WebSocket client as a link of text messages: what is read and written are lines, one message each (RFC 6455).

A capture of such a link holds the messages themselves, without the random masks of WebSocket frames, so it can be replayed.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from drivers.transport.link import LinkLost, NoAnswer, WireError, now_s
from drivers.transport.socket_link import SocketLink, open_tcp
from hal.errors import DeviceUnavailable

if TYPE_CHECKING:
    from websockets.client import ClientProtocol

LONGEST_MESSAGE = 1 << 22


class WebsocketLink:
    """Link over an open WebSocket connection; any thread may write."""

    byte_s = 0.0

    def __init__(self, socket: SocketLink, protocol: ClientProtocol, name: str) -> None:
        self.socket = socket
        self.name = name
        self._protocol = protocol
        self._using = threading.Lock()  # the protocol's state, and the order of what is sent
        self._parts: list[bytes] = []  # of a message that comes in several frames

    def read(self, until_s: float) -> bytes:
        """Return the messages that have arrived, each as one line, or `b""` when `until_s` passes without any."""
        while True:
            lines = self._lines()
            if lines:
                return lines
            chunk = self.socket.read(until_s)
            if not chunk:
                return b""
            with self._using:
                self._protocol.receive_data(chunk)
                self._flush(until_s=now_s())  # pongs, and the answer to a closing

    def write(self, data: bytes, until_s: float) -> None:
        """Send one text message.

        Raises:
            NoAnswer: another thread still sends at `until_s`. LinkLost: the connection has ended, or it does not accept the
                message in time, after which only a part of it may have been sent.
        """
        from websockets.exceptions import WebSocketException

        if not self._using.acquire(timeout=max(0.0, until_s - now_s())):
            raise NoAnswer(f"{self.name}: another write still blocks the connection")
        try:
            self._protocol.send_text(data)
            self._flush(until_s)
        except WebSocketException as error:
            raise LinkLost(f"{self.name}: {error}") from error
        finally:
            self._using.release()

    def _flush(self, until_s: float) -> None:
        data = b"".join(self._protocol.data_to_send())
        if data:
            try:
                self.socket.write(data, until_s)
            except NoAnswer as error:
                raise LinkLost(f"{self.name}: the connection accepts no data") from error

    def _lines(self) -> bytes:
        from websockets.frames import Frame, Opcode

        lines = b""
        with self._using:
            events = self._protocol.events_received()
            error = self._protocol.parser_exc
        for event in events:
            if not isinstance(event, Frame):
                continue
            if event.opcode is Opcode.CLOSE:
                raise LinkLost(f"{self.name}: the server closed the connection")
            if event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(bytes(event.data))
                if event.fin:
                    lines += b"".join(self._parts).replace(b"\n", b" ") + b"\n"
                    self._parts.clear()
        if error is not None and not lines:
            raise LinkLost(f"{self.name}: {error}")
        return lines

    def is_present(self) -> bool:
        """Return True: a connection has no path that could vanish."""
        return True

    def cancel(self) -> None:
        """Make a waiting read and all later ones raise `LinkLost`."""
        self.socket.cancel()

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self.socket.close()


def open_websocket(host: str, port: int, *, timeout_s: float, device: str) -> WebsocketLink:
    """Connect to `ws://host:port/` within `timeout_s`.

    Raises:
        DeviceUnavailable: nothing there accepts the connection, or it is no WebSocket server.
    """
    from websockets.client import ClientProtocol
    from websockets.uri import parse_uri

    until_s = now_s() + timeout_s
    uri = f"ws://[{host}]:{port}/" if ":" in host else f"ws://{host}:{port}/"
    socket = open_tcp(host, port, timeout_s=timeout_s, device=device)
    protocol = ClientProtocol(parse_uri(uri), max_size=LONGEST_MESSAGE)
    try:
        _shake_hands(socket, protocol, until_s)
    except Exception as error:
        socket.close()
        raise DeviceUnavailable(
            f"{device}: {host}:{port} is no WebSocket server: {error}",
            hint="is it rosbridge (`ros2 launch rosbridge_server rosbridge_websocket_launch.xml`), and is the port right?",
            device=device,
            link=uri,
        ) from error
    return WebsocketLink(socket, protocol, f"websocket {host}:{port}")


def _shake_hands(socket: SocketLink, protocol: ClientProtocol, until_s: float) -> None:
    from websockets.protocol import State

    protocol.send_request(protocol.connect())
    socket.write(b"".join(protocol.data_to_send()), until_s)
    while protocol.state is State.CONNECTING:
        chunk = socket.read(until_s)
        if not chunk:
            raise NoAnswer("it does not answer")
        protocol.receive_data(chunk)
        if protocol.handshake_exc is not None:
            raise WireError(str(protocol.handshake_exc))
