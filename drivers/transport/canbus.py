"""CAN frames over an slcan adapter (serial or TCP) or Linux SocketCAN, as bytes on a link, which captures and re-opens."""

from __future__ import annotations

import socket
import struct
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

from pydantic import Field, model_validator

from drivers.transport.fd_link import FdLink
from drivers.transport.link import Link
from drivers.transport.options import CONNECT_TIMEOUT_S, Captured, opener_with_files
from drivers.transport.serial_link import open_serial
from drivers.transport.socket_link import open_tcp
from hal.errors import DeviceUnavailable
from hal.wires import ResourceClaim

SLCAN_RATES = {rate: code for code, rate in enumerate((10, 20, 50, 100, 125, 250, 500, 800, 1000))}  # kbit/s
RAW = struct.Struct("<IB3x8s")
NO_DATA = 0xE0000000  # flags of extended identifiers, remote requests and error frames (linux/can.h)
LONGEST_LINE = 32
STAMP_CHARS = 4  # milliseconds, where the adapter was told once to add them
TCP = "tcp://"


class CanOptions(Captured):
    """Keys of every CAN device.

    `channel` is the path of an slcan adapter, `tcp://HOST:PORT` of one on the network, or an interface's name (`can0`).
    """

    channel: str
    bitrate: Literal[10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000] = 1_000_000
    baud: Annotated[int, Field(ge=300, le=4_500_000)] = 115_200

    @property
    @abstractmethod
    def stations(self) -> tuple[str, ...]:
        """What of the bus is this device's alone."""

    def claim(self) -> ResourceClaim:
        """Its stations; an adapter on a serial port is opened for one device, whatever hangs on its bus."""
        if self.is_slcan and tcp_address(self.channel) is None:
            return ResourceClaim(wire=f"serial {self.channel}")
        return ResourceClaim(wire=f"CAN {self.channel}", bus=f"CAN at {self.bitrate} bit/s", stations=self.stations)

    @property
    def is_slcan(self) -> bool:
        """Adapter or SocketCAN?"""
        return "/" in self.channel

    @model_validator(mode="after")
    def _names_a_host(self) -> CanOptions:
        if self.channel.startswith(TCP) and tcp_address(self.channel) is None:
            raise ValueError(f"channel: {self.channel!r} is not tcp://HOST:PORT")
        return self


@dataclass(frozen=True, slots=True)
class CanFrame:
    """Identifier and up to eight bytes."""

    id: int
    data: bytes


class CanCodec(Protocol):
    """Frames in and out of a link's bytes."""

    def opening(self, bitrate: int) -> bytes:
        """What opens the channel."""
        ...

    def encode(self, frame: CanFrame) -> bytes:
        """One frame."""
        ...

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """The frames that are complete now; damaged ones are counted in `bad`."""
        ...


class Slcan:
    """`tIIILDD..` and a carriage return a frame, maybe with a time stamp (Lawicel CAN232 manual).

    `z`, a bare return and BEL acknowledge.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.bad = 0

    def opening(self, bitrate: int) -> bytes:
        """Close, set the rate, open."""
        return b"\rC\rS%d\rO\r" % SLCAN_RATES[bitrate // 1000]

    def encode(self, frame: CanFrame) -> bytes:
        """One line."""
        return b"t%03X%d%s\r" % (frame.id, len(frame.data), frame.data.hex().upper().encode())

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """Lines to frames."""
        *lines, self._buffer = (self._buffer + chunk).replace(b"\x07", b"\r").split(b"\r")
        self._buffer = self._buffer[-LONGEST_LINE:]
        # No hex digit is a `t`: the last one begins the frame, whatever noise stands before it.
        frames = [self._line(line[line.rindex(b"t") :]) for line in lines if b"t" in line]
        return [frame for frame in frames if frame is not None]

    def _line(self, line: bytes) -> CanFrame | None:
        try:
            identifier, length = int(line[1:4], 16), int(line[4:5])
            data = bytes.fromhex(line[5 : 5 + 2 * length].decode("ascii"))
        except ValueError:
            self.bad += 1
            return None
        if (
            length != len(data)
            or length > 8
            or identifier > 0x7FF
            or len(line) - 2 * length not in (5, 5 + STAMP_CHARS)
        ):
            self.bad += 1
            return None
        return CanFrame(identifier, data)


class RawCan:
    """The kernel's 16-byte frames."""

    def opening(self, bitrate: int) -> bytes:  # noqa: ARG002  # the system sets the rate: ip link set can0 ...
        """Nothing."""
        return b""

    def encode(self, frame: CanFrame) -> bytes:
        """One frame."""
        return RAW.pack(frame.id, len(frame.data), frame.data)

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """The socket gives whole frames; those that are no data of an 11-bit identifier are others' business."""
        whole = chunk[: len(chunk) // RAW.size * RAW.size]
        return [CanFrame(id_, data[:length]) for id_, length, data in RAW.iter_unpack(whole) if not id_ & NO_DATA]


def tcp_address(channel: str) -> tuple[str, int] | None:
    """Host and port of `tcp://HOST:PORT`; None for other channels."""
    host, _, port = channel.removeprefix(TCP).rpartition(":")
    is_address = channel.startswith(TCP) and host and port.isascii() and port.isdigit() and int(port) < 65_536
    return (host, int(port)) if is_address else None


def can_opener(options: CanOptions, device: str) -> tuple[Callable[[], Link], Callable[[], CanCodec], str]:
    """What opens the channel, what makes its codec, and its name."""
    address = tcp_address(options.channel)
    if address is not None:
        opener = opener_with_files(
            options, device, lambda: open_tcp(*address, timeout_s=CONNECT_TIMEOUT_S, device=device)
        )
        return opener, Slcan, f"slcan {options.channel}, {options.bitrate} bit/s"
    if options.is_slcan:
        opener = opener_with_files(
            options, device, lambda: open_serial(options.channel, baud=options.baud, device=device)
        )
        return opener, Slcan, f"slcan {options.channel}, {options.bitrate} bit/s"
    opener = opener_with_files(options, device, lambda: open_socketcan(options.channel, device=device))
    return opener, RawCan, f"can {options.channel}"


def open_socketcan(interface: str, *, device: str) -> Link:
    """A raw CAN socket.

    Raises:
        DeviceUnavailable: no such interface, or it is down.
    """
    try:
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            sock.bind((interface,))
        except OSError:
            sock.close()
            raise
    except (OSError, AttributeError) as error:
        raise DeviceUnavailable(
            f"{device}: CAN interface {interface!r} cannot be opened: {error}",
            hint=f"sudo ip link set {interface} up type can bitrate 1000000",
            device=device,
        ) from error
    sock.setblocking(False)
    return FdLink(sock.detach(), f"can {interface}")
