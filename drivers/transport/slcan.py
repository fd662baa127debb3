"""slcan adapters, on a serial port or TCP, as python-can interface `panelwright_slcan` (Lawicel CAN232 manual).

python-can's own `slcan` sleeps for two seconds when it opens, reads byte by byte, raises on a damaged line or takes it
with the data that are left, and shares the port with other programs.
"""

from __future__ import annotations

import time
from binascii import hexlify, unhexlify
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, NamedTuple

import can
from can.util import CAN_FD_DLC, len2dlc

from drivers.transport.can_frames import EXTENDED, LONGEST_CLASSIC
from drivers.transport.fd_link import FdLink
from drivers.transport.link import LinkLost, NoAnswer, now_s
from drivers.transport.options import CONNECT_TIMEOUT_S
from drivers.transport.serial_link import open_serial
from drivers.transport.socket_link import open_tcp
from hal.errors import CellError

INTERFACE = "panelwright_slcan"
RATES = {1000 * rate: code for code, rate in enumerate((10, 20, 50, 100, 125, 250, 500, 800, 1000))}
DATA_RATES = {2_000_000: b"Y2\r", 5_000_000: b"Y5\r"}  # of the CANable 2.0 firmware
STAMP_CHARS, STAMP_TURN_MS = 4, 60_000  # milliseconds, if time stamps were once enabled in the adapter
LONGEST_LINE = 1 + 8 + 1 + 2 * 64 + STAMP_CHARS
ODD_LINES = 3  # so many lines in a row with, or without, a time stamp show that the adapter has been set so
TCP = "tcp://"
FOREVER_S = 1e6
CLOSING_S = 0.02
LAST_ID, LAST_EXTENDED_ID = 0x7FF, 0x1FFFFFFF
PLAIN, ZERO = ord("t"), ord("0")
FD = b"dDbB"
EXTENDED_KINDS, REMOTE_KINDS, SWITCHED_KINDS = b"TRDB", b"rR", b"bB"


def tcp_address(channel: str) -> tuple[str, int] | None:
    """Return host and port of `tcp://HOST:PORT`, or None for other channels."""
    host, _, port = channel.removeprefix(TCP).rpartition(":")
    is_address = channel.startswith(TCP) and host and port.isascii() and port.isdigit() and int(port) < 65_536
    return (host, int(port)) if is_address else None


class Line(NamedTuple):
    """One frame of an slcan adapter: kind letter, identifier, number of data bytes, data, and the adapter's clock."""

    kind: int
    id: int
    length: int
    data: bytes
    stamp_ms: int | None = None


class LineReader:
    """Reads frames from the bytes of an adapter.

    `z`, a bare carriage return and BEL are acknowledgements and carry no frame. A line that has lost or gained
    characters is no frame. An adapter adds a time stamp to every line or to none, so a line that differs from those
    before it is damaged too: without two of its data bytes, a line looks like a shorter one with a time stamp.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self._is_stamped: bool | None = None
        self._odd = 0
        self.bad = 0

    def feed(self, chunk: bytes) -> list[Line]:
        """Return the frames in the lines completed by this chunk; damaged ones are counted in `bad`."""
        *lines, self._buffer = (self._buffer + chunk).replace(b"\x07", b"\r").split(b"\r")
        self._buffer = self._buffer[-LONGEST_LINE:]
        return [frame for line in lines if line and (frame := self._frame(line)) is not None]

    def _frame(self, line: bytes) -> Line | None:
        if self._is_stamped is False and (frame := plain_frame(line)) is not None:
            self._odd = 0
            return frame
        # These letters are no hex digits, so the last of them begins the frame, whatever noise precedes it.
        start = max(line.rfind(b"t"), line.rfind(b"T"), line.rfind(b"r"), line.rfind(b"R"))
        if start < 0 and line[0] not in FD:
            return None
        try:
            frame = read_line(line[max(start, 0) :])
        except (ValueError, IndexError):
            self.bad += 1
            return None
        if not self._is_expected(frame.stamp_ms is not None):
            self.bad += 1
            return None
        return frame

    def _is_expected(self, is_stamped: bool) -> bool:
        self._odd = 0 if self._is_stamped in (None, is_stamped) else self._odd + 1
        if self._is_stamped is None or self._odd >= ODD_LINES:
            self._is_stamped, self._odd = is_stamped, 0
        return self._odd == 0


def plain_frame(line: bytes) -> Line | None:
    """Return the frame of the usual kind of line (11 bits, data, no time stamp), or None if it must be looked at closely."""
    if line[0] != PLAIN or len(line) < 5 or not 0 <= (length := line[4] - ZERO) <= LONGEST_CLASSIC:
        return None
    if len(line) != 5 + 2 * length:
        return None
    try:
        id_ = int.from_bytes(unhexlify(b"0" + line[1:4]), "big")
        return Line(PLAIN, id_, length, unhexlify(line[5:])) if id_ <= LAST_ID else None
    except ValueError:
        return None


def read_line(line: bytes) -> Line:
    """Return the frame that a line holds.

    Raises:
        ValueError, IndexError: it is none.
    """
    kind = line[0]
    at = 9 if kind in EXTENDED_KINDS else 4
    # `int` and `bytes.fromhex` would also take spaces, signs and underscores.
    id_ = int.from_bytes(unhexlify(line[1:at].rjust(8, b"0")), "big")
    (code,) = unhexlify(b"0" + line[at : at + 1])
    if id_ > (LAST_EXTENDED_ID if kind in EXTENDED_KINDS else LAST_ID) or (code > LONGEST_CLASSIC and kind not in FD):
        raise ValueError("identifier or length out of range")
    length: int = CAN_FD_DLC[code]
    end = at + 1 + (0 if kind in REMOTE_KINDS else 2 * length)
    data, rest = unhexlify(line[at + 1 : end]), line[end:]
    if (kind not in REMOTE_KINDS and len(data) != length) or len(rest) not in (0, STAMP_CHARS):
        raise ValueError("characters lost or added")
    stamp_ms = int.from_bytes(unhexlify(rest), "big") if rest else None
    if stamp_ms is not None and stamp_ms >= STAMP_TURN_MS:
        raise ValueError("time stamp out of range")
    return Line(kind, id_, length, data, stamp_ms)


def line_of(id_: int, data: bytes, *, remote_length: int | None = None, is_fd: bool = False) -> bytes:
    """Return a frame as a line; `id_` has the flag `EXTENDED` for 29 bits.

    Args:
        remote_length: number of bytes that a remote frame asks for; None for a frame with data.
        is_fd: whether to send a CAN FD frame, at the data bit rate.
    """
    number = b"%08X" % (id_ ^ EXTENDED) if id_ & EXTENDED else b"%03X" % id_
    kind = b"r" if remote_length is not None else b"b" if is_fd else b"t"
    length = len(data) if remote_length is None else remote_length
    code = len2dlc(length) if is_fd else length
    padding = bytes(CAN_FD_DLC[code] - length)
    digits = hexlify(data + padding if is_fd else data).upper()
    return b"%s%s%X%s\r" % (kind.upper() if id_ & EXTENDED else kind, number, code, digits)


class SlcanBus(can.BusABC):
    """python-can bus of one slcan adapter, which it opens exclusively.

    Args:
        channel: path of the serial port, or `tcp://HOST:PORT`.
        bitrate: bit rate of the bus.
        tty_baudrate: baud rate of the serial port.
        fd: whether to accept and send CAN FD frames.
        data_bitrate: bit rate of their data.
        listen_only: whether to open the bus without acknowledging frames.
        device: name in error messages.

    Raises:
        CanInitializationError: the port cannot be opened; its cause is the error of the port.
        ValueError: an argument is not one that the adapter can be set to.
    """

    def __init__(
        self,
        channel: str,
        bitrate: int = 1_000_000,
        *,
        tty_baudrate: int = 115_200,
        fd: bool = False,
        data_bitrate: int = 2_000_000,
        listen_only: bool = False,
        device: str = "slcan adapter",
        can_filters: Any = None,
    ) -> None:
        if bitrate not in RATES or data_bitrate not in DATA_RATES:
            raise ValueError(f"an slcan adapter has the bit rates {list(RATES)} and, for data, {list(DATA_RATES)}")
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._lines = LineReader()
        self._received: deque[can.Message] = deque()
        self._stamps = _Stamps()
        self.has_clock = False  # whether frames have the adapter's time stamps; else they have the host's
        self.channel_info = f"slcan {channel}"
        self.link = _opened(channel, tty_baudrate, device)
        rates = b"S%d\r" % RATES[bitrate] + (DATA_RATES[data_bitrate] if fd else b"")
        try:
            self._write(b"\rC\r" + rates + (b"L\r" if listen_only else b"O\r"), 1.0)
        except can.CanError as error:
            self.link.close()
            raise can.CanInitializationError(str(error)) from error
        super().__init__(channel=channel, can_filters=can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._received:
            try:
                chunk = self.link.read(now_s() + (FOREVER_S if timeout is None else timeout))
            except LinkLost as error:
                raise can.CanOperationError(str(error)) from error
            arrived_s = time.time()
            self._received += [self._message(line, arrived_s) for line in self._lines.feed(chunk)] if chunk else ()
        return (self._received.popleft() if self._received else None), False

    def _message(self, line: Line, arrived_s: float) -> can.Message:
        if line.kind == PLAIN and line.stamp_ms is None:
            return can.Message(arrived_s, line.id, is_extended_id=False, data=line.data)
        self.has_clock = self.has_clock or line.stamp_ms is not None
        return can.Message(
            timestamp=arrived_s if line.stamp_ms is None else self._stamps.seconds(line.stamp_ms, arrived_s),
            arbitration_id=line.id,
            is_extended_id=line.kind in EXTENDED_KINDS,
            is_remote_frame=line.kind in REMOTE_KINDS,
            is_fd=line.kind in FD,
            bitrate_switch=line.kind in SWITCHED_KINDS,
            dlc=line.length,
            data=line.data,
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame."""
        self.send_all((msg,), timeout)

    def send_all(self, messages: Iterable[can.Message], timeout: float | None = None) -> None:
        """Send frames in one write, so that nothing comes between them.

        Raises:
            CanTimeoutError: the port accepts no more. CanOperationError: the port is gone.
        """
        self._write(b"".join(map(_as_line, messages)), timeout)

    def _write(self, data: bytes, timeout: float | None) -> None:
        try:
            self.link.write(data, now_s() + (FOREVER_S if timeout is None else timeout))
        except NoAnswer as error:
            raise can.CanTimeoutError(str(error)) from error
        except LinkLost as error:
            raise can.CanOperationError(str(error)) from error

    def shutdown(self) -> None:
        """Close channel and port; a second call does nothing."""
        if not self._is_shutdown:
            with suppress(can.CanError):
                self._write(b"C\r", CLOSING_S)
        super().shutdown()
        self.link.close()


class _Stamps:
    """Counts on the adapter's clock, which begins again every minute, from the time of the first frame."""

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._last_s = self._arrived_s = 0.0

    def seconds(self, stamp_ms: int, arrived_s: float) -> float:
        """Return the time of a frame; whole minutes without a frame are counted by the host's clock."""
        if self._last_ms is None:
            self._last_s = arrived_s
        else:
            step_s, turn_s = (stamp_ms - self._last_ms) % STAMP_TURN_MS / 1e3, STAMP_TURN_MS / 1e3
            turns = max(0, round((arrived_s - self._arrived_s - step_s) / turn_s))
            self._last_s += step_s + turns * turn_s
        self._last_ms, self._arrived_s = stamp_ms, arrived_s
        return self._last_s


def _as_line(message: can.Message) -> bytes:
    id_ = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
    if message.is_remote_frame:
        return line_of(id_, b"", remote_length=message.dlc)
    return line_of(id_, bytes(message.data), is_fd=message.is_fd)


def _opened(channel: str, baud: int, device: str) -> FdLink:
    address = tcp_address(channel)
    try:
        if address is None:
            return open_serial(channel, baud=baud, device=device)
        return open_tcp(*address, timeout_s=CONNECT_TIMEOUT_S, device=device)
    except CellError as error:
        raise can.CanInitializationError(f"{error.what}: {error.hint}") from error
