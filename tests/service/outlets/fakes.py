"""A cell for outlets: readings and changes of alarms that tests add, a service that may be silent, and no real pauses."""

from __future__ import annotations

import asyncio
from typing import Any

from hal.errors import DeviceUnavailable
from service.outlets.source import CellState, Changes, Cursor, Deed, Instrument, instruments_of

READING: dict[str, Any] = {
    "id": 0, "object": "pressure", "kind": "gauge", "utc_s": 1.79e9, "quality": "valid", "cause": "", "value": 1.0, "unit": "bar",
    "sigma": 0.1, "state": None, "text": None, "confidence": 0.9, "sure": True, "task": "t",
}  # fmt: skip
ALARM: dict[str, Any] = {
    "id": "pressure.high", "object": "pressure", "kind": "high", "number": 0, "state": "unacknowledged", "is_active": True,
    "says": "pressure is 7 bar, above 6", "changed_s": 1.79e9, "by": "the cell", "reason": "",
}  # fmt: skip
PANEL: dict[str, Any] = {
    "objects": [
        {"name": "pressure", "kind": "gauge", "label": "P1", "priority": "high",
         "scale": {"minimum": 0.0, "maximum": 10.0, "unit": "bar"}},
        {"name": "temperature", "kind": "display", "label": "T1", "unit": "degC", "minimum": 0, "maximum": 199.9},
        {"name": "pump_lamp", "kind": "lamp", "label": ""},
    ]
}  # fmt: skip


class FakeSource:
    """A source whose changes stand in lists; `batch` of them come at a time."""

    def __init__(self, *, batch: int = 7) -> None:
        self.readings: list[dict[str, Any]] = []
        self.alarms: list[dict[str, Any]] = []
        self.is_silent, self.batch = False, batch
        self.changed = asyncio.Event()
        self.acts: list[tuple[str, Deed, str, str]] = []

    def reads(self, value: float | None, **given: Any) -> None:
        """Add a reading; None is a refused one."""
        quality = {} if value is not None else {"quality": "invalid", "cause": "glare"}
        self.readings.append({**READING, "id": len(self.readings) + 1, "value": value, **quality, **given})
        self.changed.set()

    def alarms_change(self, **given: Any) -> None:
        """Add a change of an alarm."""
        self.alarms.append({**ALARM, "number": len(self.alarms) + 1, **given})
        self.changed.set()

    async def changes(self, cursor: Cursor, *, wait_s: float) -> Changes:
        if self.is_silent:
            raise DeviceUnavailable("the service does not answer", hint="wait")
        if cursor.reading is None or cursor.alarm is None:
            return Changes(cursor=Cursor(reading=len(self.readings), alarm=len(self.alarms)))
        while True:
            self.changed.clear()
            readings = self.readings[cursor.reading : cursor.reading + self.batch]
            alarms = self.alarms[cursor.alarm : cursor.alarm + self.batch]
            if readings or alarms:
                at = Cursor(reading=cursor.reading + len(readings), alarm=cursor.alarm + len(alarms))
                return Changes(readings=tuple(readings), alarms=tuple(alarms), cursor=at)
            if not wait_s:
                return Changes(cursor=cursor)
            await self.changed.wait()

    async def state(self) -> CellState:
        if self.is_silent:
            raise DeviceUnavailable("the service does not answer", hint="wait")
        return CellState(
            readings={one["object"]: one for one in self.readings},
            alarms={one["id"]: one for one in self.alarms},
            is_ready=True,
        )

    async def panel(self) -> tuple[Instrument, ...]:
        if self.is_silent:
            raise DeviceUnavailable("the service does not answer", hint="wait")
        return instruments_of(PANEL)

    async def act(self, alarm: str, deed: Deed, *, by: str, reason: str) -> None:
        self.acts.append((alarm, deed, by, reason))
        state = "acknowledged" if deed == "acknowledge" else self.alarms[-1]["state"]
        self.alarms_change(id=alarm, state=state, by=by, reason=reason, changed_s=ALARM["changed_s"] + len(self.acts))


async def no_pause(_seconds: float) -> None:
    """Let others run instead of waiting."""
    await asyncio.sleep(0.01)
