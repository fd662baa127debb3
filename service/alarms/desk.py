"""Keeps the alarms of a cell: takes readings, lets time pass, obeys people, and records every change with who made it."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hal.atomic_write import write_atomically
from hal.errors import CellError, InvalidRequest
from hal.panel import Panel, PanelObject
from service.access.actor import actor
from service.alarms.conditions import Verdict, Watch
from service.alarms.lifecycle import Alarm, State
from service.errors import NoSuchTask
from service.history.reading import StoredReading

THE_CELL = "the cell"
KIND = "alarm"  # of the journal's rows
MOST_SHELVED_S = 31 * 86_400.0
log = logging.getLogger(__name__)


def steady_utc_s() -> Callable[[], float]:
    """Return a clock in seconds since 1970 that goes on steadily when the machine's clock is set."""
    offset_s = time.time() - time.monotonic()
    return lambda: time.monotonic() + offset_s


class AlarmDesk:
    """The alarms of the objects that have limits or normal states in the panel file.

    A change is in the journal before it is shown; a change that cannot be recorded does not take place.

    Args:
        panel: the panel file.
        path: JSON file of the newest states, so that they outlive the journal's oldest parts.
        commit: records durably: (kind, data); raises `JournalError`.
        recorded: data of the journal's rows of kind `alarm`, oldest first, for the start.
        valid_at_s: when each object was read validly last, seconds since 1970, for the start.
        now_s: seconds since 1970; see `steady_utc_s`.
    """

    def __init__(
        self,
        panel: Panel,
        *,
        path: Path,
        commit: Callable[[str, dict[str, Any]], None],
        recorded: Iterable[Mapping[str, Any]] = (),
        valid_at_s: Mapping[str, float] | None = None,
        now_s: Callable[[], float] | None = None,
    ) -> None:
        self._path, self._commit = path, commit
        self._now_s = steady_utc_s() if now_s is None else now_s
        known, start_s = valid_at_s or {}, self._now_s()
        watches = [Watch(panel_object=one, valid_at_s=known.get(one.name, start_s)) for one in panel.objects]
        self._order = [one.name for one in panel.objects]
        self._watches = {watch.panel_object.name: watch for watch in watches if watch.kinds}
        self._lock = threading.RLock()
        self._number = 0
        self._alarms = {
            alarm.id: alarm
            for watch in self._watches.values()
            for alarm in (Alarm(object=watch.panel_object.name, kind=kind) for kind in watch.kinds)
        }
        self._restore(recorded)

    @property
    def number(self) -> int:
        """Number of the newest change."""
        return self._number

    def all(self) -> list[Alarm]:
        """Return all alarms, also normal ones, in the order of the panel file."""
        with self._lock:
            return list(self._alarms.values())

    def doubts(self) -> dict[str, str]:
        """Return sentences about limits that the newest interval straddles without an alarm, by the alarm's name."""
        with self._lock:
            return {f"{name}.{kind}": told for name, w in self._watches.items() for kind, told in w.doubts.items()}

    def get(self, alarm: str) -> Alarm:
        """Return the alarm called `alarm`.

        Raises:
            NoSuchTask: there is no such alarm.
        """
        with self._lock:
            found = self._alarms.get(alarm)
        if found is None:
            raise NoSuchTask("there is no such alarm", hint="GET /v1/alarms?all=true lists them")
        return found

    def redefine(self, panel_object: PanelObject, newest: StoredReading | None) -> None:
        """Watch an object by other limits from now on; its newest reading is judged by them at once.

        Raises:
            JournalError: the end of an alarm whose limit is gone, or a new alarm, could not be recorded.
        """
        name = panel_object.name
        with self._lock:
            before = self._watches.pop(name, None)
            valid_at_s = before.valid_at_s if before is not None else self._now_s()
            watch = Watch(panel_object=panel_object, valid_at_s=valid_at_s)
            for alarm in [one for one in self._alarms.values() if one.object == name and one.kind not in watch.kinds]:
                if alarm.state is not State.NORMAL:
                    gone = Alarm(object=name, kind=alarm.kind)
                    self._change(alarm, gone, by=actor() or THE_CELL, reason="its limit was taken away")
                del self._alarms[alarm.id]
            if watch.kinds:
                self._watches[name] = watch
            for kind in watch.kinds:
                self._alarms.setdefault(f"{name}.{kind}", Alarm(object=name, kind=kind))
            in_order = sorted(self._alarms.values(), key=lambda one: self._order.index(one.object))
            self._alarms = {one.id: one for one in in_order}
            self._save()
            if newest is not None and watch.kinds:
                valid_at_s = watch.valid_at_s
                self._apply(name, watch.takes(newest, self._now_s(), self._asks(name)))
                watch.valid_at_s = valid_at_s  # it was read when it was read

    def take(self, readings: Sequence[StoredReading]) -> None:
        """Judge new readings.

        Raises:
            JournalError: a change could not be recorded.
        """
        with self._lock:
            for reading in readings:
                watch = self._watches.get(reading.object)
                if watch is not None:
                    self._apply(reading.object, watch.takes(reading, self._now_s(), self._asks(reading.object)))

    def tick(self) -> None:
        """Let time pass: delays, readings that become stale, and shelving that ends; a failure is tried again later."""
        now_s = self._now_s()
        try:
            with self._lock:
                for name, watch in self._watches.items():
                    self._apply(name, watch.passes(now_s))
                for alarm in self._alarms.values():
                    if alarm.shelved_until_s is not None and now_s >= alarm.shelved_until_s:
                        self._change(alarm, alarm.unshelved(), by=THE_CELL, reason="the time of its shelving has ended")
        except CellError as error:
            log.error("a change of an alarm is not recorded yet: %s", error.what)

    def acknowledge(self, alarm: str, *, by: str, reason: str = "") -> Alarm:
        """Record that a person has seen an alarm.

        Raises:
            NoSuchTask: there is no such alarm.
            NotPossibleNow: its state does not allow it; the same holds for the other deeds of people.
            JournalError: it could not be recorded, so nothing has changed.
        """
        return self._by_person(alarm, Alarm.acknowledged, by, reason)

    def shelve(self, alarm: str, *, until_s: float, by: str, reason: str) -> Alarm:
        """Shelve an alarm until a time, seconds since 1970; raises as `acknowledge`.

        Raises:
            InvalidRequest: the time has passed, or is more than 31 days ahead.
        """
        left_s = until_s - self._now_s()
        if not 0.0 < left_s <= MOST_SHELVED_S:
            raise InvalidRequest(
                "the shelving must end within 31 days from now", hint="give a later or earlier until_s"
            )
        return self._by_person(alarm, lambda found: found.shelved(until_s), by, reason)

    def unshelve(self, alarm: str, *, by: str, reason: str = "") -> Alarm:
        """End the shelving of an alarm; raises as `acknowledge`."""
        return self._by_person(alarm, Alarm.unshelved, by, reason)

    def take_out_of_service(self, alarm: str, *, by: str, reason: str) -> Alarm:
        """Take an alarm out of service, for example while its instrument is repaired; raises as `acknowledge`."""
        return self._by_person(alarm, Alarm.out_of_service, by, reason)

    def put_in_service(self, alarm: str, *, by: str, reason: str = "") -> Alarm:
        """Put an alarm back in service; raises as `acknowledge`."""
        return self._by_person(alarm, Alarm.in_service, by, reason)

    def comment(self, alarm: str, *, by: str, reason: str) -> Alarm:
        """Record what a person says about an alarm, whose state stays; raises as `acknowledge`."""
        return self._by_person(alarm, lambda found: found, by, reason)

    def _by_person(self, alarm: str, change: Callable[[Alarm], Alarm], by: str, reason: str) -> Alarm:
        with self._lock:
            found = self.get(alarm)
            return self._change(found, change(found), by=by, reason=reason)

    def _asks(self, name: str) -> Callable[[str], bool]:
        return lambda kind: self._alarms[f"{name}.{kind}"].is_active

    def _apply(self, name: str, verdicts: Mapping[str, Verdict]) -> None:
        for kind, verdict in verdicts.items():
            alarm = self._alarms.get(f"{name}.{kind}")
            if alarm is None:
                continue
            if verdict.holds and not alarm.is_active:
                risen = replace(alarm.rises(), says=verdict.says, straddles=verdict.straddles, raised_s=self._now_s())
                self._change(alarm, risen, by=THE_CELL, reason=verdict.says)
            elif verdict.holds:  # the same condition with another value is no change of the alarm
                self._alarms[alarm.id] = replace(alarm, says=verdict.says, straddles=verdict.straddles)
            elif alarm.is_active:
                self._change(
                    alarm, replace(alarm.clears(), straddles=False), by=THE_CELL, reason="its condition has ended"
                )

    def _change(self, before: Alarm, after: Alarm, *, by: str, reason: str) -> Alarm:
        """Record a change, then make it."""
        key_name = None if by == THE_CELL else actor()
        after = replace(after, changed_s=self._now_s(), by=by, key_name=key_name, reason=reason)
        told = {**asdict(after), "before": str(before.state), "number": self._number + 1}
        self._commit(KIND, {key: value for key, value in told.items() if value is not None})
        self._number += 1
        self._alarms[after.id] = after
        self._save()
        return after

    def _save(self) -> None:
        states = [asdict(alarm) for alarm in self._alarms.values()]
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, json.dumps({"schema": 1, "number": self._number, "alarms": states}))
        except OSError as error:  # the journal has the change
            log.warning("the states of the alarms cannot be saved in %s: %s", self._path, error)

    def _restore(self, recorded: Iterable[Mapping[str, Any]]) -> None:
        """Take the states from the file, and the changes after it from the journal."""
        try:
            saved = json.loads(self._path.read_text(encoding="utf-8"))
            entries, self._number = list(saved["alarms"]), int(saved["number"])
        except FileNotFoundError:
            entries = []
        except (OSError, ValueError, LookupError, TypeError) as error:
            log.error("the states of the alarms in %s are damaged; the journal is used: %s", self._path, error)
            entries = []
        saved_number = self._number
        for row in recorded:
            if int(row.get("number", 0)) > saved_number:
                entries.append(row)
                self._number = max(self._number, int(row["number"]))
        for entry in entries:
            fields = {key: entry[key] for key in Alarm.__dataclass_fields__ if key in entry}
            alarm = Alarm(**{**fields, "state": State(fields["state"])})
            if alarm.id in self._alarms:  # the panel file may have changed
                self._alarms[alarm.id] = alarm
