"""CAN frames over an slcan adapter (serial or TCP) or Linux SocketCAN, as a link that can be captured and reopened."""

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
STAMP_CHARS = 4  # milliseconds, if time stamps were once enabled in the adapter
TCP = "tcp://"


class CanOptions(Captured):
    """Keys of every CAN device.

    `channel` is the path of an slcan adapter, `tcp://HOST:PORT` of one on the network, or an interface's name (`can0`).
    """

    channel: Annotated[
        str,
        Field(
            description="path of an slcan adapter, `tcp://HOST:PORT` of one on the network, or the name of a SocketCAN interface"
        ),
    ]
    bitrate: Annotated[
        Literal[10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000],
        Field(description="bit rate of the bus, bit/s"),
    ] = 1_000_000
    baud: Annotated[int, Field(ge=300, le=4_500_000, description="baud rate of the adapter's serial port")] = 115_200

    @property
    @abstractmethod
    def stations(self) -> tuple[str, ...]:
        """Return the identifiers on the bus that belong to this device alone."""

    def claim(self) -> ResourceClaim:
        """Claim the device's stations; a serial adapter is claimed whole, because only one device can open it."""
        if self.is_slcan and tcp_address(self.channel) is None:
            return ResourceClaim(wire=f"serial {self.channel}")
        return ResourceClaim(wire=f"CAN {self.channel}", bus=f"CAN at {self.bitrate} bit/s", stations=self.stations)

    @property
    def is_slcan(self) -> bool:
        """Return whether the channel is an slcan adapter (True) or SocketCAN (False)."""
        return "/" in self.channel

    @model_validator(mode="after")
    def _names_a_host(self) -> CanOptions:
        if self.channel.startswith(TCP) and tcp_address(self.channel) is None:
            raise ValueError(f"channel: {self.channel!r} is not tcp://HOST:PORT")
        return self


@dataclass(frozen=True, slots=True)
class CanFrame:
    """CAN frame: identifier and up to eight data bytes."""

    id: int
    data: bytes


class CanCodec(Protocol):
    """Converts CAN frames to and from the bytes of a link."""

    def opening(self, bitrate: int) -> bytes:
        """Return the bytes that open the channel at this bit rate."""
        ...

    def encode(self, frame: CanFrame) -> bytes:
        """Return one frame as bytes."""
        ...

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """Return the frames completed by this chunk; damaged ones are counted in `bad`."""
        ...


class Slcan:
    """slcan codec: each frame is `tIIILDD..`, an optional time stamp and a carriage return (Lawicel CAN232 manual).

    `z`, a bare carriage return and BEL are acknowledgements and carry no frame.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.bad = 0

    def opening(self, bitrate: int) -> bytes:
        """Return the commands that close the channel, set the bit rate and open it."""
        return b"\rC\rS%d\rO\r" % SLCAN_RATES[bitrate // 1000]

    def encode(self, frame: CanFrame) -> bytes:
        """Return the frame as one slcan line."""
        return b"t%03X%d%s\r" % (frame.id, len(frame.data), frame.data.hex().upper().encode())

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """Return the frames in the lines completed by this chunk."""
        *lines, self._buffer = (self._buffer + chunk).replace(b"\x07", b"\r").split(b"\r")
        self._buffer = self._buffer[-LONGEST_LINE:]
        # `t` is not a hex digit, so the last `t` begins the frame, whatever noise precedes it.
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
    """Codec for the 16-byte frames of Linux SocketCAN."""

    def opening(self, bitrate: int) -> bytes:  # noqa: ARG002  # the system sets the rate: ip link set can0 ...
        """Return nothing: the interface is already configured."""
        return b""

    def encode(self, frame: CanFrame) -> bytes:
        """Return the frame in the kernel's format."""
        return RAW.pack(frame.id, len(frame.data), frame.data)

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """Return the data frames with 11-bit identifiers; the socket delivers whole frames, and other types are ignored."""
        whole = chunk[: len(chunk) // RAW.size * RAW.size]
        return [CanFrame(id_, data[:length]) for id_, length, data in RAW.iter_unpack(whole) if not id_ & NO_DATA]


def tcp_address(channel: str) -> tuple[str, int] | None:
    """Return host and port of `tcp://HOST:PORT`, or None for other channels."""
    host, _, port = channel.removeprefix(TCP).rpartition(":")
    is_address = channel.startswith(TCP) and host and port.isascii() and port.isdigit() and int(port) < 65_536
    return (host, int(port)) if is_address else None


def can_opener(options: CanOptions, device: str) -> tuple[Callable[[], Link], Callable[[], CanCodec], str]:
    """Return a function that opens the channel, one that creates its codec, and the channel's name."""
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
    """Open a raw CAN socket on `interface`.

    Raises:
        DeviceUnavailable: the interface does not exist or is down.
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
