"""CAN frames over any adapter that python-can knows, as a link that can be captured, replayed and reopened."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from difflib import get_close_matches
from typing import Annotated, Any

import can
from pydantic import Field, model_validator

from drivers.transport.can_frames import EXTENDED, HEAD, LONGEST_CLASSIC, MARK, records
from drivers.transport.fd_link import LOOK_UP_S
from drivers.transport.link import CountingLink, Link, LinkLost, NoAnswer, now_s
from drivers.transport.options import Captured, opener_with_files
from drivers.transport.slcan import INTERFACE, RATES, SlcanBus, tcp_address
from hal.errors import CellError, DeviceUnavailable
from hal.wires import ResourceClaim

SLCAN, SOCKETCAN = "slcan", "socketcan"
SHARED = ("remote", SOCKETCAN, "socketcand", "udp_multicast", "virtual")  # each device opens the bus for itself
MOST_AT_ONCE = 512  # frames handed over by one read
logging.getLogger("can").setLevel(logging.CRITICAL)  # it logs each attempt to open an adapter; we raise what it says
Plain = str | int | float | bool


class CanOptions(Captured):
    """Keys of every CAN device."""

    channel: Annotated[
        str | int,
        Field(
            description="path of an slcan adapter, `tcp://HOST:PORT` of one on the network, the name of a SocketCAN "
            "interface (`can0`), or a channel as `interface` names it"
        ),
    ]
    interface: Annotated[
        str | None,
        Field(
            description="adapter as python-can names it (pcan, kvaser, vector, ixxat, gs_usb, usb2can, virtual, ...); "
            "without it, a path or `tcp://` means slcan and any other channel socketcan"
        ),
    ] = None
    bitrate: Annotated[
        int,
        Field(ge=5_000, le=1_000_000, description="bit rate of the bus, bit/s; the system sets that of SocketCAN"),
    ] = 1_000_000
    baud: Annotated[
        int, Field(ge=300, le=4_500_000, description="baud rate of the serial port of an slcan adapter")
    ] = 115_200
    fd: Annotated[bool, Field(description="whether to open the bus for CAN FD frames too")] = False
    adapter_options: Annotated[
        dict[str, Plain | dict[str, Plain]],
        Field(
            description="further arguments of python-can's bus for this adapter, such as `data_bitrate`, or a table "
            "`timing` with the arguments of `can.BitTiming` (with `fd`: `can.BitTimingFd`)"
        ),
    ] = {}

    @property
    @abstractmethod
    def stations(self) -> tuple[str, ...]:
        """Return the identifiers on the bus that belong to this device alone."""

    def claim(self) -> ResourceClaim:
        """Claim the device's stations, or the whole adapter where only one device can open it."""
        is_serial = self.adapter == SLCAN and tcp_address(str(self.channel)) is None
        if is_serial or self.adapter not in (SLCAN, *SHARED):
            return ResourceClaim(wire=f"serial {self.channel}" if is_serial else f"CAN {self.adapter} {self.channel}")
        return ResourceClaim(wire=f"CAN {self.channel}", bus=f"CAN at {self.bitrate} bit/s", stations=self.stations)

    @property
    def adapter(self) -> str:
        """Return the interface: as given, or as the channel tells."""
        return self.interface or (SLCAN if "/" in str(self.channel) else SOCKETCAN)

    @model_validator(mode="after")
    def _can_be_opened(self) -> CanOptions:
        if self.adapter not in can.VALID_INTERFACES:
            near = get_close_matches(self.adapter, can.VALID_INTERFACES, n=1)
            told = f"is it {near[0]!r}?" if near else f"python-can has {', '.join(sorted(can.VALID_INTERFACES))}"
            raise ValueError(f"interface: there is no {self.adapter!r}; {told} (others are packages to install)")
        if isinstance(self.channel, int) and self.interface is None:
            raise ValueError(f"channel: {self.channel} is a number, so give `interface` too")
        if self.adapter != SLCAN:
            return self
        if "://" in str(self.channel) and tcp_address(str(self.channel)) is None:
            raise ValueError(f"channel: {self.channel!r} is not tcp://HOST:PORT")
        if self.bitrate not in RATES:
            raise ValueError(f"bitrate: an slcan adapter has {', '.join(map(str, RATES))}")
        return self


class CanLink(CountingLink):
    """Link over a python-can bus; its bytes are records of frames. Remote frames and error frames are left out."""

    def __init__(self, bus: can.BusABC, name: str) -> None:
        self._bus = bus
        self._name = name
        self._slcan = bus if isinstance(bus, SlcanBus) else None
        self._is_cancelled = False

    @property
    def name(self) -> str:
        """Return the name shown to people."""
        return self._name

    @property
    def byte_s(self) -> float:
        """Return 0: a bus delivers whole frames."""
        return 0.0

    def read(self, until_s: float) -> bytes:
        """Return the frames that have arrived: at least one, or `b""` at `until_s`."""
        try:
            chunk = b""
            while not chunk and (message := self._first(until_s)) is not None:
                chunk = self._with_what_waits(message)
        except LinkLost:
            raise
        except Exception as error:  # each adapter's library raises errors of its own
            raise LinkLost(f"{self._name}: {error}") from error
        self.received = self.received + len(chunk) if self._slcan is None else self._slcan.link.received
        return chunk

    def _with_what_waits(self, message: can.Message | None) -> bytes:
        found: list[bytes] = []
        while message is not None:
            found.append(_record(message, self._slcan is None or self._slcan.has_clock))
            message = self._bus.recv(0.0) if len(found) < MOST_AT_ONCE else None
        return b"".join(found)

    def _first(self, until_s: float) -> can.Message | None:
        while not self._is_cancelled:
            wait_s = max(0.0, until_s - now_s())
            message = self._bus.recv(min(wait_s, LOOK_UP_S))
            if message is not None or wait_s <= LOOK_UP_S:
                return message
        raise LinkLost(f"{self._name} is being closed")

    def cancel(self) -> None:
        """Make a waiting read and all later ones raise `LinkLost`; the owner closes the link."""
        self._is_cancelled = True

    def write(self, data: bytes, until_s: float) -> None:
        """Send the frames of `data` before `until_s`; only the owner thread may call this."""
        messages = [_message(id_, payload) for id_, payload, _ in records(data)]
        try:
            if self._slcan is not None:
                self._slcan.send_all(messages, max(0.0, until_s - now_s()))
                return
            for message in messages:
                self._bus.send(message, max(0.0, until_s - now_s()))
        except can.CanTimeoutError as error:
            raise NoAnswer(f"{self._name}: the adapter accepts no more frames: {error}") from error
        except Exception as error:  # each adapter's library raises errors of its own
            raise LinkLost(f"{self._name}: {error}") from error

    def is_present(self) -> bool:
        """Return whether the path of an slcan adapter still leads to it; other adapters report their loss."""
        return self._slcan is None or self._slcan.link.is_present()

    def close(self) -> None:
        """Shut the bus down; a second call does nothing."""
        self.cancel()
        with suppress(Exception):  # the library of an adapter that has been unplugged may raise anything
            self._bus.shutdown()


def _record(message: can.Message, is_stamped: bool) -> bytes:
    data = message.data
    if message.is_error_frame or message.is_remote_frame or not message.is_rx or message.dlc != len(data):
        return b""
    id_ = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
    return HEAD.pack(MARK, len(data), message.timestamp if is_stamped else 0.0, id_) + data


def _message(id_: int, data: bytes) -> can.Message:
    is_fd = len(data) > LONGEST_CLASSIC
    return can.Message(
        arbitration_id=id_ & ~EXTENDED,
        is_extended_id=bool(id_ & EXTENDED),
        data=data,
        is_fd=is_fd,
        bitrate_switch=is_fd,
    )


def can_opener(options: CanOptions, device: str) -> tuple[Callable[[], Link], str]:
    """Return a function that opens the bus, and the bus's name."""
    name = f"CAN {options.adapter} {options.channel}, {options.bitrate} bit/s"
    return opener_with_files(options, device, lambda: _open(options, device, name)), name


def _open(options: CanOptions, device: str, name: str) -> CanLink:
    is_ours = options.adapter == SLCAN  # python-can's own is slow and takes damaged lines
    extra: dict[str, Any] = {**options.adapter_options, **({"fd": True} if options.fd else {})}
    if is_ours:
        extra = {"tty_baudrate": options.baud, "device": device, **extra}
    try:
        if isinstance(timing := extra.get("timing"), dict):
            extra["timing"] = (can.BitTimingFd if options.fd else can.BitTiming)(**timing)
        bus = can.Bus(
            options.channel,
            INTERFACE if is_ours else options.adapter,
            ignore_config=True,  # what counts is in the cell file
            bitrate=options.bitrate,
            **extra,
        )
    except Exception as error:  # each adapter's library raises errors of its own
        if isinstance(error.__cause__, CellError):
            raise error.__cause__ from None
        what, hint = f"{device}: {name} cannot be opened: {error}", _remedy(options, error)
        raise DeviceUnavailable(what, hint=hint, device=device) from error
    return CanLink(bus, name)


def _remedy(options: CanOptions, error: Exception) -> str:
    if options.adapter == SOCKETCAN:
        return f"sudo ip link set {options.channel} up type can bitrate {options.bitrate}"
    if isinstance(error, can.CanInterfaceNotImplementedError | ImportError):
        return f"install the maker's driver and library as python-can's page on {options.adapter!r} says"
    if isinstance(error, TypeError | ValueError):
        return "correct channel, bitrate and adapter_options; python-can's page on the adapter lists them"
    return "is the adapter plugged in and used by no other program? `panelwright doctor` lists the adapters found"
