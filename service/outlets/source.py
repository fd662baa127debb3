"""What outlets are told: the changes of a cell in order, from a place that each remembers, and its state now."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from hal.atomic_write import write_atomically

CURSOR_BYTES = 80  # less than a sector, which a disk writes as a whole or not at all
Deed = Literal["acknowledge", "comment"]  # what an outlet may do about an alarm, if the cell file allows it


@dataclass(frozen=True, slots=True, kw_only=True)
class Cursor:
    """The newest reading and the newest change of an alarm that were told; None before anything was."""

    reading: int | None = None
    alarm: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """What has happened after a cursor, as the HTTP API shows it, and the cursor after it."""

    readings: tuple[Mapping[str, Any], ...] = ()
    alarms: tuple[Mapping[str, Any], ...] = ()
    cursor: Cursor


@dataclass(frozen=True, slots=True, kw_only=True)
class CellState:
    """The state of a cell: the newest reading of each object, all alarms, and the devices, as the HTTP API shows them."""

    readings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    alarms: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    devices: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    is_ready: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """An object of the panel as the panel file describes it.

    Attributes:
        name, kind, label: of the panel file; `label` is what stands beside it.
        unit, low, high: of its scale; an object without one has no range.
        priority: of its alarms.
    """

    name: str
    kind: str
    label: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None
    priority: str = "medium"


def instruments_of(panel: Mapping[str, Any]) -> tuple[Instrument, ...]:
    """Return the objects of a panel as `GET /v1/panel` shows it."""
    found = []
    for one in panel["objects"]:
        scale = one.get("scale") or one
        has_scale = isinstance(scale.get("minimum"), float | int) and isinstance(scale.get("maximum"), float | int)
        found.append(
            Instrument(
                name=one["name"],
                kind=one["kind"],
                label=str(one.get("label") or ""),
                unit=str(scale.get("unit") or ""),
                low=float(scale["minimum"]) if has_scale else None,
                high=float(scale["maximum"]) if has_scale else None,
                priority=one.get("priority", "medium"),
            )
        )
    return tuple(found)


class Source(Protocol):
    """A cell as outlets see it."""

    async def changes(self, cursor: Cursor, *, wait_s: float) -> Changes:
        """Return what came after a cursor, oldest first; waits for something at most `wait_s`. Without a cursor: nothing yet.

        Raises:
            CellError: the service does not answer.
        """
        ...

    async def state(self) -> CellState:
        """Return the state now; raises as `changes`."""
        ...

    async def panel(self) -> tuple[Instrument, ...]:
        """Return the objects of the panel; raises as `changes`."""
        ...

    async def act(self, alarm: str, deed: Deed, *, by: str, reason: str) -> None:
        """Acknowledge an alarm for somebody, or comment on it.

        Raises:
            CellError: the service does not answer, or refuses.
        """
        ...


class Kept(Protocol):
    """Where a cursor is kept between two batches."""

    def load(self) -> Cursor:
        """Return the saved cursor; an empty one before the first."""
        ...

    def save(self, cursor: Cursor) -> None:
        """Save a cursor, after all before it was delivered."""
        ...


class Memory:
    """A cursor for an outlet that tells the state anew whenever it begins."""

    def __init__(self) -> None:
        self._cursor = Cursor()

    def load(self) -> Cursor:
        """Return the saved cursor."""
        return self._cursor

    def save(self, cursor: Cursor) -> None:
        """Save a cursor until this process ends."""
        self._cursor = cursor


class CursorFile:
    """A cursor that outlives the gateway.

    It is overwritten in its place: to replace the file takes four times as many turns of a disk for which the history waits, too.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self) -> Cursor:
        """Return the saved cursor; without a readable file an empty one."""
        try:
            saved = json.loads(self._path.read_text(encoding="utf-8"))
            return Cursor(reading=saved["reading"], alarm=saved["alarm"])
        except (OSError, ValueError, LookupError, TypeError):
            return Cursor()

    def save(self, cursor: Cursor) -> None:
        """Save a cursor, after all before it was delivered."""
        text = json.dumps({"reading": cursor.reading, "alarm": cursor.alarm}).ljust(CURSOR_BYTES)
        try:
            number = os.open(self._path, os.O_WRONLY)
        except FileNotFoundError:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, text)
            return
        try:
            os.pwrite(number, text.encode(), 0)
            os.fsync(number)
        finally:
            os.close(number)


def told(reading: Mapping[str, Any]) -> dict[str, Any]:
    """Return a reading as outlets tell it: what is shown, how good it is, and its number, by which a repeat is recognised."""
    keys = (
        "id",
        "object",
        "kind",
        "utc_s",
        "quality",
        "cause",
        "value",
        "unit",
        "sigma",
        "state",
        "text",
        "confidence",
    )
    return {key: reading[key] for key in (*keys, "sure", "task")}
