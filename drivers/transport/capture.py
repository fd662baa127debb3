"""Records the traffic of a link in a file, and replays such a file in place of the link.

The file holds one JSON object per line. `{"t": s, "dir": "rx", "hex": "5959.."}` is the result of one read; empty reads
are recorded too, because drivers react to silence. `"tx"` is one write. `"open"` is an opening of the port, with the
link's name and the duration of one byte.
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

EARLY_S = 0.01  # a replay is never exactly in step: data due this soon counts as having arrived already
WRITE_IN_S = 0.5  # a request that is this late is taken as one that will not be written
AHEAD_S = 0.2  # search window for a recorded request; an equal request further ahead is a different one
L = TypeVar("L")


class CaptureLink:
    """Link that writes all traffic to a file."""

    def __init__(self, inner: Link, path: Path) -> None:
        self.inner = inner
        self._file = path.open("a", encoding="ascii", buffering=1)
        self._start_s = now_s()
        self._write_line({"t": 0.0, "dir": "open", "name": inner.name, "byte_s": inner.byte_s})

    @property
    def name(self) -> str:
        """Return the name of the wrapped link."""
        return self.inner.name

    @property
    def byte_s(self) -> float:
        """Return the byte duration of the wrapped link, in seconds."""
        return self.inner.byte_s

    def read(self, until_s: float) -> bytes:
        """Read from the wrapped link and record the result, also when it is empty."""
        chunk = self.inner.read(until_s)
        self._note("rx", chunk)
        return chunk

    def write(self, data: bytes, until_s: float) -> None:
        """Write to the wrapped link and record the data."""
        self._note("tx", data)
        self.inner.write(data, until_s)

    def is_present(self) -> bool:
        """Return whether the wrapped link's port is present."""
        return self.inner.is_present()

    def cancel(self) -> None:
        """Cancel reads of the wrapped link, if it supports that."""
        if isinstance(self.inner, Cancellable):
            self.inner.cancel()

    def close(self) -> None:
        """Close the link and the file."""
        self.inner.close()
        self._file.close()

    def _note(self, direction: str, data: bytes) -> None:
        self._write_line({"t": round(now_s() - self._start_s, 6), "dir": direction, "hex": data.hex()})

    def _write_line(self, line: dict[str, Any]) -> None:
        with suppress(ValueError):  # the owner thread closed the file meanwhile; the wrapped link reports the loss
            self._file.write(json.dumps(line) + "\n")


def inside(link: Link, kind: type[L]) -> L | None:
    """Return `link`, or the link that it captures, if that is of type `kind`; else None."""
    found = link.inner if isinstance(link, CaptureLink) else link
    return found if isinstance(found, kind) else None


def captured(opener: Callable[[], Link], path: Path, device: str) -> Callable[[], Link]:
    """Return a function that opens the link together with its capture file.

    Raises (by the returned function):
        DeviceUnavailable: the link cannot be opened, or the file cannot be written.
    """

    def opened() -> Link:
        link = opener()
        try:
            return CaptureLink(link, path)
        except OSError as error:
            link.close()  # otherwise the next attempt would find the port held by this process
            what = f"{device}: the capture {path} cannot be written: {error.strerror or error}"
            hint = "name a file in a folder that exists and may be written to"
            raise DeviceUnavailable(what, hint=hint, device=device) from error

    return opened


@dataclass(frozen=True, slots=True)
class Event:
    """One recorded read or write, `t_s` seconds after the port was opened."""

    t_s: float
    is_read: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class PortRecording:
    """Recording from one opening of the port to its loss."""

    name: str
    byte_s: float
    events: tuple[Event, ...]


def read_capture(path: Path) -> list[PortRecording]:
    """Return the sessions of a capture file.

    Raises:
        ConfigError: the file does not exist or is not a capture; the message names file and line.
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
                    continue  # notes that a program has added to the capture
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break  # the writer was killed in the middle of a line
            what = f"{path}, line {number} is not a line of a capture: {error!r}"
            raise ConfigError(what, hint="give a file that `capture` has written") from error
    return [PortRecording(name, byte_s, tuple(events)) for name, byte_s, events in sessions]


class ReplayLink:
    """Link that replays a session: recorded data comes at its recorded time, if the recorded requests are written.

    Data read after a request is held back until that request is written or its time is over. Each request restarts the
    time base, so on a busy machine a replay runs later but stays the same. The end of the recording is a lost link.
    """

    def __init__(self, session: PortRecording) -> None:
        self._events = list(session.events[::-1])  # reversed: the next event is the last element
        self._name = f"replay of {session.name}"
        self._byte_s = session.byte_s
        self._start_s = now_s()
        self._written = threading.Condition()

    @property
    def name(self) -> str:
        """Return `replay of LINK`."""
        return self._name

    @property
    def byte_s(self) -> float:
        """Return the recorded byte duration, in seconds."""
        return self._byte_s

    def read(self, until_s: float) -> bytes:
        """Return the data of the next recorded read, or `b""` when none is due before `until_s`."""
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
            raise RecordingEnded(f"{self._name} has ended")

    def write(self, data: bytes, until_s: float) -> None:  # noqa: ARG002  # a file accepts any data at once
        """Release the data that was read after the same bytes were written in the recording."""
        with self._written:
            latest_s, is_next = now_s() - self._start_s + AHEAD_S, True
            for i in range(len(self._events) - 1, -1, -1):
                event = self._events[i]
                if event.t_s > latest_s:
                    return
                if not event.is_read and event.data == data:
                    if is_next:
                        self._start_s = now_s() - event.t_s
                    # Skip recorded silence before this request: how often a driver reads depends on how busy it is.
                    self._events[i:] = [e for e in self._events[i + 1 :] if e.data or not e.is_read]
                    self._written.notify_all()
                    return
                is_next &= event.is_read

    def is_present(self) -> bool:
        """Return True: a recording cannot be unplugged."""
        return True

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


def replay_opener(path: Path, device: str) -> Callable[[], Link]:
    """Return a function that opens the sessions of a capture one after another, as the recorded driver opened its port.

    Raises:
        ConfigError: the file is not a capture.
    """
    sessions = deque(read_capture(path))

    def opened() -> Link:
        if not sessions:
            what, hint = (
                f"{device}: the recording {path.name} has ended",
                "connect the device again to replay it from the beginning",
            )
            raise DeviceUnavailable(what, hint=hint, device=device, recording="ended")
        return ReplayLink(sessions.popleft())

    return opened
