"""Traffic of a wire in a file, and such a file in the place of the wire.

One JSON object a line. `{"t": s, "dir": "rx", "hex": "5959.."}` is what one read brought (nothing, too: a driver acts on
silence as on bytes), `"tx"` what was written, `"open"` an opening of the port, with its name and the time of a byte.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from drivers.transport.link import Cancellable, Link, RecordingEnded, now_s
from hal.errors import ConfigError, DeviceUnavailable

EARLY_S = 0.01  # a replay is never quite in step; what is due so soon was there when the recorded driver looked
WRITE_IN_S = 0.5  # a request that comes later than that will not be made
AHEAD_S = 0.2  # a request is looked for so far ahead; a later one of the same bytes is another
L = TypeVar("L")


class CaptureLink:
    """A link that writes all traffic to a file."""

    def __init__(self, inner: Link, path: Path) -> None:
        self.inner = inner
        self._file = path.open("a", encoding="ascii", buffering=1)
        self._start_s = now_s()
        self._write_line({"t": 0.0, "dir": "open", "name": inner.name, "byte_s": inner.byte_s})

    @property
    def name(self) -> str:
        """Name of the link inside."""
        return self.inner.name

    @property
    def byte_s(self) -> float:
        """As the link inside."""
        return self.inner.byte_s

    def read(self, until_s: float) -> bytes:
        """As the link inside."""
        chunk = self.inner.read(until_s)
        self._note("rx", chunk)
        return chunk

    def write(self, data: bytes, until_s: float) -> None:
        """As the link inside."""
        self._note("tx", data)
        self.inner.write(data, until_s)

    def is_present(self) -> bool:
        """As the link inside."""
        return self.inner.is_present()

    def cancel(self) -> None:
        """As the link inside, where it can."""
        if isinstance(self.inner, Cancellable):
            self.inner.cancel()

    def close(self) -> None:
        """Close link and file."""
        self.inner.close()
        self._file.close()

    def _note(self, direction: str, data: bytes) -> None:
        self._write_line({"t": round(now_s() - self._start_s, 6), "dir": direction, "hex": data.hex()})

    def _write_line(self, line: dict[str, Any]) -> None:
        with suppress(ValueError):  # closed by the owner thread meanwhile: the link inside says so
            self._file.write(json.dumps(line) + "\n")


def inside(link: Link, kind: type[L]) -> L | None:
    """The link itself, or the one that is captured, if it is of that kind: for what only some links can do."""
    found = link.inner if isinstance(link, CaptureLink) else link
    return found if isinstance(found, kind) else None


def captured(opener: Callable[[], Link], path: Path, device: str) -> Callable[[], Link]:
    """What opens the link and the file that its traffic goes to.

    Raises (what is returned):
        DeviceUnavailable: the link cannot be opened, or the file not be written.
    """

    def opened() -> Link:
        link = opener()
        try:
            return CaptureLink(link, path)
        except OSError as error:
            link.close()  # or the next attempt would find the port taken, by us
            what = f"{device}: the capture {path} cannot be written: {error.strerror or error}"
            hint = "name a file in a folder that exists and may be written to"
            raise DeviceUnavailable(what, hint=hint, device=device) from error

    return opened


@dataclass(frozen=True, slots=True)
class Event:
    """One read or write of a recording, `t_s` after the port was opened."""

    t_s: float
    is_read: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class Session:
    """From one opening of the port to its loss."""

    name: str
    byte_s: float
    events: tuple[Event, ...]


def read_capture(path: Path) -> list[Session]:
    """The sessions of a capture file.

    Raises:
        ConfigError: no such file, or not a capture; names file and line.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}", hint="give a file that `capture` has written") from error
    sessions: list[tuple[str, float, list[Event]]] = []
    for number, line in enumerate(lines, start=1):
        try:
            entry = json.loads(line)
            match entry["dir"]:
                case "open":
                    sessions.append((str(entry["name"]), float(entry["byte_s"]), []))
                case "rx" | "tx":
                    if not sessions:
                        sessions.append((path.name, 0.0, []))
                    is_read = entry["dir"] == "rx"
                    sessions[-1][2].append(Event(float(entry["t"]), is_read, bytes.fromhex(entry["hex"])))
                case _:
                    continue  # what a program has noted about the capture
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break  # the writer was killed in the middle of a line
            what = f"{path}, line {number} is no line of a capture: {error!r}"
            raise ConfigError(what, hint="give a file that `capture` has written") from error
    return [Session(name, byte_s, tuple(events)) for name, byte_s, events in sessions]


class ReplayLink:
    """Gives what the recorded driver read, when it read it, provided that it is asked what the recorded driver asked.

    What was read after a request is held back until the request is written, or its time is over; each request sets the
    pace anew, so that a replay on a busy machine is later and not another. The end of the recording is the loss of the link.
    """

    def __init__(self, session: Session) -> None:
        self._events = list(session.events[::-1])  # the next one is the last
        self._name = f"replay of {session.name}"
        self._byte_s = session.byte_s
        self._start_s = now_s()
        self._written = threading.Condition()

    @property
    def name(self) -> str:
        """`replay of LINK`."""
        return self._name

    @property
    def byte_s(self) -> float:
        """As recorded."""
        return self._byte_s

    def read(self, until_s: float) -> bytes:
        """What the next recorded read brought."""
        until_s = max(until_s, now_s())
        with self._written:
            while self._events:
                event = self._events[-1]
                due_s = self._start_s + event.t_s + (0.0 if event.is_read else WRITE_IN_S)
                if due_s > until_s + EARLY_S or (not event.is_read and due_s > until_s):
                    self._written.wait(max(0.0, until_s - now_s()))
                    if now_s() >= until_s:
                        return b""
                elif now_s() < due_s:
                    self._written.wait(due_s - now_s())
                else:
                    self._events.pop()
                    if event.is_read:
                        return event.data
            raise RecordingEnded(f"{self._name} is at its end")

    def write(self, data: bytes, until_s: float) -> None:  # noqa: ARG002  # a file takes anything at once
        """Let go what was read after the same bytes had been written."""
        with self._written:
            latest_s, is_next = now_s() - self._start_s + AHEAD_S, True
            for i in range(len(self._events) - 1, -1, -1):
                event = self._events[i]
                if event.t_s > latest_s:
                    return
                if not event.is_read and event.data == data:
                    if is_next:
                        self._start_s = now_s() - event.t_s
                    # Silence that was heard before it is over: how often a driver looks depends on how busy it is.
                    self._events[i:] = [e for e in self._events[i + 1 :] if e.data or not e.is_read]
                    self._written.notify_all()
                    return
                is_next &= event.is_read

    def is_present(self) -> bool:
        """A recording stays."""
        return True

    def close(self) -> None:
        """Nothing to release."""


def replay_opener(path: Path, device: str) -> Callable[[], Link]:
    """Opens one session of a capture after the other, as the recorded driver opened its port.

    Raises:
        ConfigError: the file is no capture.
    """
    sessions = deque(read_capture(path))

    def opened() -> Link:
        if not sessions:
            what, hint = f"{device}: the recording {path.name} is at its end", "connect again to see it again"
            raise DeviceUnavailable(what, hint=hint, device=device, recording="ended")
        return ReplayLink(sessions.popleft())

    return opened
