"""What a service keeps and watches beyond its tasks: the history with its review, the alarms and the rounds of one cell."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hal.config import Cell
from hal.errors import CellError, ConfigError
from hal.panel import Panel
from hal.panel.limits import Limits
from hal.plant import RoundSection
from service.alarms.desk import AlarmDesk
from service.alarms.limit_book import LimitBook, with_limits
from service.calendar import calendar_clock
from service.certificate.record import Certificate
from service.errors import HistoryError, NoSuchTask
from service.history.observer import Observations
from service.history.reading import StoredReading
from service.history.store import History
from service.missions.files import checked_file
from service.review.desk import ReviewDesk
from service.review.doubts import Doubts
from service.rounds.book import RoundBook
from service.rounds.cell import RunningCell
from service.rounds.keeper import RoundKeeper
from service.tasks.journal import Journal

TICK_S = 1.0
RESTORED_ALARMS = 1000

Record = Callable[[str, dict[str, Any]], None]


class Plant:
    """The history, its review, the alarms and the rounds; they go by the calendar of `by_calendar` if there is one.

    Args:
        state_dir: folder of their files.
        note, commit: write to the journal, without and with waiting for the disk.

    Raises:
        ConfigError: a round names a mission or an alarm that the cell does not have.
        HistoryError: a file is of a newer version, or cannot be used.
    """

    def __init__(self, cell: Cell, state_dir: Path, *, journal: Journal, note: Record, commit: Record) -> None:
        self._cell = cell
        self._calendar = calendar_clock()
        self._now_s = self._calendar or time.time
        self.history = self._open_history(state_dir / "history", note)
        self._journal, self._commit = journal, commit
        self.limits = LimitBook(state_dir / "limits.json")
        self.changes = 0  # rises with each reading and each change of an alarm
        self.listeners: list[Callable[[], None]] = []  # told of each, in the thread that made it
        self._alarm_changes = deque(self._recorded_alarms(), maxlen=RESTORED_ALARMS)
        self.alarms = self._open_alarms(state_dir / "alarms.json")
        self.review = ReviewDesk(self.history, cell.panel, cell=cell.name, commit=commit, now_s=self._now_s)
        asked = cell.file.review
        newest = [row.reading for row in self.history.reader().newest(cell.name)]
        doubts = Doubts(self.panel, sure_at=asked.sure_at, audit_share=asked.audit_share, earlier=newest)
        self._certificate = Certificate(cell.certificate_path, panel=cell.panel.name, sure_at=asked.sure_at)
        self.observations = Observations(
            history=self.history,
            listeners=[self._note_change, self.alarms.take],  # who follows the feed need not wait for the journal
            doubt_of=doubts.of,
            certify=self._certify,
            alarms=self._active_alarms,
            now_s=self._now_s,
        )
        self._is_closing = threading.Event()
        self.check_rounds(cell.file.rounds, source=str(cell.path))
        self._book = RoundBook(state_dir / "rounds" / f"{cell.name}.sqlite")
        if self._book.set_aside_now is not None:
            note("rounds-set-aside", {"file": str(self._book.set_aside_now)})

    def keep_rounds(self, running: Callable[[Callable[[str], bool]], RunningCell]) -> None:
        """Prepare the rounds.

        Args:
            running: returns what begins and forbids rounds, given what says whether an alarm's condition holds.
        """
        asked = running(self._is_active)
        self.rounds = RoundKeeper(self._cell.file.rounds, book=self._book, cell=asked, now_s=self._now_s)

    def start(self, *, keeps_rounds: bool) -> None:
        """Let the time of the alarms pass and begin rounds, each in a thread of its own, because both wait for the disk."""
        ticks = [self.alarms.tick, *([self.rounds.tick] if keeps_rounds else [])]
        for tick in ticks:
            threading.Thread(target=self._repeat, args=(tick,), name="plant", daemon=True).start()

    def close(self) -> None:
        """End the threads and close the files."""
        self._is_closing.set()
        self.history.close()
        self._book.close()

    def check_rounds(self, sections: Sequence[RoundSection], *, source: str) -> None:
        """Check rounds against the cell: their missions, as `check_mission`, and the alarms that forbid them.

        Raises:
            ConfigError: names every fault.
        """
        known, faults = [alarm.id for alarm in self.alarms.all()], list[str]()
        for k, one in enumerate(sections):
            faults += [
                f"rounds.{k}.forbidden_by: there is no alarm {alarm!r}; alarms: {', '.join(known) or 'none'}"
                for alarm in one.forbidden_by
                if alarm not in known
            ]
            try:
                checked_file(one.mission, self._cell)
            except CellError as error:
                faults.append(f"rounds.{k}.mission: {error.what}; {error.hint}")
        if faults:
            more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
            raise ConfigError(f"{source}: {faults[0]}{more}", hint="correct the rounds", faults=faults)

    @property
    def panel(self) -> Panel:
        """The panel of the cell with the limits that people have set."""
        return self.limits.applied(self._cell.panel)

    def set_limits(self, name: str, limits: Limits | None) -> None:
        """Watch an object by other limits; None: by those of the panel file.

        Raises:
            NoSuchTask: the panel has no object of that name.
            InvalidRequest: an object of this kind cannot have them.
            JournalError: it could not be recorded, so nothing has changed.
            HistoryError: it could not be stored, so nothing has changed.
        """
        of_file = next((one for one in self._cell.panel.objects if one.name == name), None)
        if of_file is None:
            raise NoSuchTask(f"the panel has no object {name!r}", hint="GET /v1/panel names its objects")
        after = of_file if limits is None else with_limits(of_file, limits)
        told = None if limits is None else limits.model_dump(mode="json", exclude_none=True)
        self._commit("limits-set", {"object": name, "limits": told})
        try:
            self.limits.put(name, limits)
        except OSError as error:
            raise HistoryError(
                f"the limits cannot be stored: {error}", hint="free the disk, then set them again"
            ) from error
        newest = next(
            (row.reading for row in self.history.reader().newest(self._cell.name) if row.reading.object == name), None
        )
        self.alarms.redefine(after, newest)
        self._note_change()

    def alarm_changes(self, after: int) -> list[dict[str, Any]]:
        """Return the changes of alarms with a greater number, oldest first; at most the newest thousand."""
        wanted = (data for data in list(self._alarm_changes) if data.get("number", 0) > after)
        return [{"key_name": None, **data, "id": f"{data['object']}.{data['kind']}"} for data in wanted]

    def _recorded_alarms(self) -> list[dict[str, Any]]:
        return [record.data for record in self._journal.records(kinds=("alarm",), limit=RESTORED_ALARMS)]

    def _commit_alarm(self, kind: str, data: dict[str, Any]) -> None:
        self._commit(kind, data)
        self._alarm_changes.append(data)
        self._note_change()

    def _note_change(self, _readings: Sequence[StoredReading] = ()) -> None:
        self.changes += 1
        for tell in self.listeners:
            tell()

    def _certify(self, reading: StoredReading, crop: bytes | None) -> str:
        return self._certificate.of(reading.kind, crop, is_sure=reading.is_sure)

    def _active_alarms(self) -> list[dict[str, str]]:
        return [
            {"object": one.name, "kind": a.kind, "says": a.says, "priority": one.priority, "what_to_do": one.what_to_do}
            for a in self.alarms.all()
            if a.is_active
            for one in [self._cell.panel.object(a.object)]
        ]

    def _is_active(self, alarm: str) -> bool:
        return self.alarms.get(alarm).is_active

    def _repeat(self, tick: Callable[[], None]) -> None:
        while not self._is_closing.wait(TICK_S):
            tick()

    def _open_history(self, folder: Path, note: Record) -> History:
        """Open the history of readings; a damaged file is set aside, and the journal says so."""
        cell = self._cell
        history = History(folder, cell=cell.name, panel=cell.panel.name, bounds=cell.file.history, now_s=self._now_s)
        if history.set_aside_now is not None:
            note("history-set-aside", {"file": str(history.set_aside_now)})
        return history

    def _open_alarms(self, path: Path) -> AlarmDesk:
        reader, names = self.history.reader(), [one.name for one in self._cell.panel.objects]
        return AlarmDesk(
            self.panel,
            path=path,
            commit=self._commit_alarm,
            recorded=list(self._alarm_changes),
            valid_at_s=reader.valid_at_s(self._cell.name, names),
            now_s=self._calendar,
        )
