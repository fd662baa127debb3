"""A link carries bytes under a deadline; capture and replay are links too.

Times here are `time.monotonic` seconds: a wire does not know the cell's clock. These errors stay inside `drivers`;
`drivers.transport.device` turns them into the errors of `hal` with the device's name.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Protocol

FLOOD_BYTES = 1 << 20  # more than any buffer between a device and us holds


class WireError(Exception):
    """Something went wrong on a wire."""


class LinkLost(WireError):
    """The port has gone: end of file, I/O error, its name vanished or names another device."""


class NoAnswer(WireError):
    """Nothing valid came in time."""


class BadAnswer(WireError):
    """The far side answered, but not what was asked."""


class Refused(WireError):
    """The device answered with an error report.

    Attributes:
        code: as the device's manual numbers it.
    """

    def __init__(self, what: str, *, code: int) -> None:
        super().__init__(what)
        self.code = code


class Link(Protocol):
    """Bytes both ways. One thread reads; any thread may write."""

    @property
    def name(self) -> str:
        """What a person would call it: `serial /dev/ttyUSB0, 115200 baud`."""
        ...

    @property
    def byte_s(self) -> float:
        """Seconds a byte takes on the line; 0 where bytes arrive at once."""
        ...

    def read(self, until_s: float) -> bytes:
        """What has arrived: at least one byte, or `b""` when `until_s` passes without one.

        Raises:
            LinkLost: the port has gone.
        """
        ...

    def write(self, data: bytes, until_s: float) -> None:
        """Send all of `data`.

        Raises:
            NoAnswer: the far side did not take it before `until_s`.
            LinkLost: the port has gone.
        """
        ...

    def is_present(self) -> bool:
        """Does the port's name still lead to the port that is open? Asked after silence."""
        ...

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        ...


def now_s() -> float:
    """The time that links count in."""
    return time.monotonic()


def drain(link: Link) -> bytes:
    """Everything that lies ready; whatever came before a request cannot be its answer. A flood does not hold it up."""
    late = b""
    while len(late) < FLOOD_BYTES and (chunk := link.read(0.0)):
        late += chunk
    return late


def drain_until_quiet(link: Link, *, quiet_s: float, until_s: float) -> int:
    """Throw bytes away until none has come for `quiet_s`; returns how many. Ends at `until_s` in any case."""
    dropped = 0
    while now_s() < until_s:
        chunk = link.read(min(now_s() + quiet_s, until_s))
        if not chunk:
            break
        dropped += len(chunk)
    return dropped


class CaptureLink:
    """A link that writes all traffic to a file, one JSON object a line: `{"t": s, "dir": "rx", "hex": "5959.."}`."""

    def __init__(self, inner: Link, path: Path) -> None:
        self._inner = inner
        self._file = path.open("a", encoding="ascii")
        self._start_s = now_s()

    @property
    def name(self) -> str:
        """Name of the link inside."""
        return self._inner.name

    @property
    def byte_s(self) -> float:
        """As the link inside."""
        return self._inner.byte_s

    def read(self, until_s: float) -> bytes:
        """As the link inside."""
        chunk = self._inner.read(until_s)
        if chunk:
            self._note("rx", chunk)
        return chunk

    def write(self, data: bytes, until_s: float) -> None:
        """As the link inside."""
        self._note("tx", data)
        self._inner.write(data, until_s)

    def is_present(self) -> bool:
        """As the link inside."""
        return self._inner.is_present()

    def close(self) -> None:
        """Close link and file."""
        self._inner.close()
        self._file.close()

    def _note(self, direction: str, data: bytes) -> None:
        line = {"t": round(now_s() - self._start_s, 6), "dir": direction, "hex": data.hex()}
        self._file.write(json.dumps(line) + "\n")


class ReplayLink:
    """Gives out the received bytes of a capture, at their recorded times or, unless `paced`, as fast as asked.

    What is written is accepted and forgotten. The end of the recording is the loss of the link.
    """

    def __init__(self, path: Path, *, paced: bool = False) -> None:
        lines = [json.loads(line) for line in path.read_text(encoding="ascii").splitlines()]
        self._chunks = [(float(x["t"]), bytes.fromhex(x["hex"])) for x in lines if x["dir"] == "rx"][::-1]
        self._name = f"replay of {path.name}"
        self._paced = paced
        self._start_s = now_s()

    @property
    def name(self) -> str:
        """`replay of FILE`."""
        return self._name

    @property
    def byte_s(self) -> float:
        """Not recorded."""
        return 0.0

    def read(self, until_s: float) -> bytes:
        """The next recorded chunk."""
        if not self._chunks:
            raise LinkLost(f"{self._name} is at its end")
        due_s = self._start_s + self._chunks[-1][0] if self._paced else now_s()
        if due_s > until_s:
            time.sleep(max(0.0, until_s - now_s()))
            return b""
        time.sleep(max(0.0, due_s - now_s()))
        return self._chunks.pop()[1]

    def write(self, data: bytes, until_s: float) -> None:
        """Nobody listens."""

    def is_present(self) -> bool:
        """A recording stays."""
        return True

    def close(self) -> None:
        """Nothing to release."""
        self._chunks.clear()
