"""Far side of CAN: frames as slcan lines, and a port that carries them on python-can's virtual bus."""

from __future__ import annotations

import time
from typing import Any
from uuid import uuid4

import can

from drivers.emulators.ports import FarPort, Peer
from drivers.transport.can_frames import CanFrame
from drivers.transport.slcan import LineReader, line_of

MOST_AT_ONCE = 256


class CanLines:
    """Converts data frames to slcan lines and back."""

    def __init__(self) -> None:
        self._reader = LineReader()

    def feed(self, data: bytes) -> list[CanFrame]:
        """Return the frames in the lines completed by `data`."""
        return [CanFrame(line.id, line.data) for line in self._reader.feed(data)]

    def encode(self, frame: CanFrame) -> bytes:
        """Return a frame as a line."""
        return line_of(frame.id, frame.data)


class VirtualCanPort:
    """Adapter between slcan lines and python-can's virtual bus, which joins programs of one process."""

    def __init__(self, name: str) -> None:
        self._channel = f"{name}-{uuid4().hex}"
        self._lines = CanLines()
        self._bus: can.BusABC | None = None
        self.appear()

    @property
    def address(self) -> dict[str, Any]:
        """Return `{"interface": "virtual", "channel": NAME}`."""
        return {"interface": "virtual", "channel": self._channel}

    def appear(self) -> None:
        """Join the bus."""
        self._bus = can.Bus(self._channel, "virtual", ignore_config=True)

    def vanish(self) -> None:
        """Leave the bus; frames in transit are lost."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Return the frames on the bus as lines."""
        if self._bus is None:
            time.sleep(max(0.0, timeout_s))
            return []
        lines: list[bytes] = []
        message = self._bus.recv(max(0.0, timeout_s))
        while message is not None:
            lines.append(line_of(message.arbitration_id, bytes(message.data)))
            message = self._bus.recv(0.0) if len(lines) < MOST_AT_ONCE else None
        return [(None, b"".join(lines))] if lines else []

    def send(self, peer: Peer, data: bytes) -> None:  # noqa: ARG002  # a bus has one side
        """Send the lines that hold a frame; others are lost, as in an adapter."""
        for frame in self._lines.feed(data):
            if self._bus is not None:
                message = can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
                self._bus.send(message)

    def close(self) -> None:
        """Leave the bus for good."""
        self.vanish()


def can_address(port: FarPort) -> dict[str, Any]:
    """Return the driver options that lead to a far side of CAN."""
    far = port.address
    if "interface" in far:
        return far
    return {"channel": f"tcp://{far['host']}:{far['port']}" if "host" in far else far["port"]}
