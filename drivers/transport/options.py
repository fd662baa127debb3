"""Option models that drivers share, and the functions that open a link from them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from drivers.transport.capture import captured, replay_opener
from drivers.transport.link import Link
from drivers.transport.serial_link import open_serial
from drivers.transport.socket_link import open_tcp, open_udp
from hal.registry import Context
from hal.strict import Strict, validate
from hal.wires import ResourceClaim, WireOptions

M = TypeVar("M", bound=Strict)
SerialPath = Annotated[str, Field(min_length=1)]
PortNumber = Annotated[int, Field(ge=1, le=65535)]
Seconds = Annotated[float, Field(gt=0, le=60)]
CONNECT_TIMEOUT_S = 0.5
LOOPBACK = "127.0.0.1"


class Captured(WireOptions):
    """Keys of every driver with a link: `capture` writes all traffic to a file, `replay` reads a file instead."""

    capture: Annotated[
        Path | None, Field(description="file to which all traffic of the link is appended, as JSON lines")
    ] = None
    replay: Annotated[Path | None, Field(description="captured file that is read in place of the link")] = None

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Return the claim on the link, or none when its traffic comes from a file."""
        return () if self.replay is not None else (self.claim(),)

    @abstractmethod
    def claim(self) -> ResourceClaim:
        """Return what the device claims of its link."""


class SerialOptions(Captured):
    """A serial port. Give `port` a stable name, from `/dev/serial/by-id`."""

    port: Annotated[
        SerialPath,
        Field(description="path of the serial port; names under `/dev/serial/by-id` survive re-plugging"),
    ]
    baud: Annotated[int, Field(ge=300, le=4_500_000, description="baud rate of the line, as set in the device")] = (
        115_200
    )

    def claim(self) -> ResourceClaim:
        """Claim the serial port."""
        return ResourceClaim(wire=f"serial {self.port}")


class TcpOptions(Captured):
    """A TCP server."""

    host: Annotated[str, Field(description="name or address of the device on the network")]
    port: Annotated[PortNumber, Field(description="number of its TCP port")]

    def claim(self) -> ResourceClaim:
        """Claim the TCP connection."""
        return ResourceClaim(wire=f"tcp {self.host}:{self.port}")


class UdpOptions(Captured):
    """A UDP server."""

    host: Annotated[str, Field(description="name or address of the device on the network")]
    port: Annotated[PortNumber, Field(description="number of its UDP port")]

    def claim(self) -> ResourceClaim:
        """Claim the remote address, which answers one client only."""
        return ResourceClaim(wire=f"udp {self.host}:{self.port}")


class EitherOptions(Captured):
    """Serial or TCP, by the type of `port`: a path, or a number with `host`."""

    host: Annotated[
        str | None, Field(description="name or address of the device on the network; this computer if not given")
    ] = None
    port: Annotated[
        SerialPath | PortNumber, Field(description="path of a serial port, or the number of the TCP port of `host`")
    ]
    baud: Annotated[
        int, Field(ge=300, le=4_500_000, description="baud rate of a serial line, as set in the device")
    ] = 115_200

    @property
    def transport(self) -> Literal["tcp", "serial"]:
        """Return which of the two the options select."""
        return "tcp" if isinstance(self.port, int) else "serial"

    @property
    def wire(self) -> str:
        """Return the link in words."""
        return f"tcp {self.host or LOOPBACK}:{self.port}" if self.transport == "tcp" else f"serial {self.port}"

    def claim(self) -> ResourceClaim:
        """Claim the serial port or the TCP connection."""
        return ResourceClaim(wire=self.wire)


def read_options(context: Context, options: dict[str, Any], model: type[M]) -> M:
    """Validate a driver's options; an error names `devices.NAME.options.KEY` (`ConfigError`)."""
    return validate(options, model, source=f"devices.{context.name}.options")


def serial_opener(options: SerialOptions, device: str) -> tuple[Callable[[], Link], str]:
    """Return a function that opens the port, and the link's name."""
    opener = opener_with_files(options, device, lambda: open_serial(options.port, baud=options.baud, device=device))
    return opener, f"serial {options.port}, {options.baud} baud"


def tcp_opener(options: TcpOptions, device: str) -> tuple[Callable[[], Link], str]:
    """Return a function that connects, and the link's name."""
    opener = opener_with_files(
        options, device, lambda: open_tcp(options.host, options.port, timeout_s=CONNECT_TIMEOUT_S, device=device)
    )
    return opener, f"tcp {options.host}:{options.port}"


def udp_opener(options: UdpOptions, device: str) -> tuple[Callable[[], Link], str]:
    """Return a function that creates the socket, and the link's name."""
    opener = opener_with_files(options, device, lambda: open_udp(options.host, options.port, device=device))
    return opener, f"udp {options.host}:{options.port}"


def either_opener(options: EitherOptions, device: str) -> tuple[Callable[[], Link], str]:
    """Return a function that opens the serial port or TCP connection, and the link's name."""
    if isinstance(options.port, int):
        host, number = options.host or LOOPBACK, options.port
        opener = opener_with_files(
            options, device, lambda: open_tcp(host, number, timeout_s=CONNECT_TIMEOUT_S, device=device)
        )
        return opener, f"tcp {host}:{number}"
    path = options.port
    opener = opener_with_files(options, device, lambda: open_serial(path, baud=options.baud, device=device))
    return opener, f"serial {path}, {options.baud} baud"


def opener_with_files(options: Captured, device: str, opener: Callable[[], Link]) -> Callable[[], Link]:
    """Return `opener` itself, or one that captures to or replays from a file.

    Raises:
        ConfigError: the file to replay is not a capture.
    """
    capture, replay = options.capture, options.replay
    if replay is not None:
        return replay_opener(replay, device)
    if capture is not None:
        return captured(opener, capture, device)
    return opener
