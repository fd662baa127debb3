"""The queue of readings that wait for a person, and the answers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Literal

from hal.errors import InvalidRequest
from hal.panel import Panel, PanelObject
from service.access.actor import actor
from service.errors import NotPossibleNow
from service.history.query import Row
from service.history.reading import StoredReading
from service.history.store import History

Verdict = Literal["right", "wrong", "unreadable"]
FIELDS = ("value", "state", "text")


class ReviewDesk:
    """Shows what waits, and takes answers.

    An answer is in the journal and in the history when it is shown; what was read stays beside it.

    Args:
        commit: records durably: (kind, data); raises `JournalError`.
        now_s: seconds since 1970.
    """

    def __init__(
        self,
        history: History,
        panel: Panel,
        *,
        cell: str,
        commit: Callable[[str, dict[str, Any]], None],
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._history, self._panel, self._cell = history, panel, cell
        self._commit, self._now_s = commit, now_s

    def waiting(self, *, limit: int = 100) -> tuple[int, list[Row]]:
        """Return how many readings wait, and the newest of them."""
        reader = self._history.reader()
        return reader.count_waiting(self._cell), reader.waiting(self._cell, limit=limit)

    def answer(
        self, reading_id: int, *, by: str, verdict: Verdict, reason: str, shows: dict[str, float | str | None]
    ) -> Row:
        """Store what a person says about a reading.

        Args:
            verdict: `right`: it shows what was read, or what a refusal held back. `wrong`: it shows `shows`.
                `unreadable`: its picture does not tell.
            shows: `value`, `state` or `text`; only of a wrong one.

        Raises:
            NoSuchTask, NotPossibleNow: nobody asked about this reading, or it has an answer.
            InvalidRequest: the object cannot show that, or there is nothing that could be right.
            JournalError, HistoryError: the answer could not be stored.
        """
        found = self._history.row(reading_id)
        final = self._final(found.reading, verdict, {key: item for key, item in shows.items() if item is not None})
        said = {"by": by, "key_name": actor(), "verdict": verdict, "reason": reason, "at_s": self._now_s()}
        self._commit("review", {"reading": reading_id, "object": found.reading.object, **said, **final})
        told = {key: final.get(key) for key in FIELDS}
        return self._history.answer(reading_id, said=json.dumps(said), **told)

    def to_teach(self, reading_id: int) -> tuple[StoredReading, bytes]:
        """Return an answered reading with the picture (PNG) that shows its object and the plate around it.

        Raises:
            NoSuchTask: there is no such reading in the database.
            NotPossibleNow: nobody has said what it shows, or no such picture is kept.
        """
        reading = self._history.row(reading_id).reading
        if reading.answered is None or json.loads(reading.answered)["verdict"] == "unreadable":
            raise NotPossibleNow(
                f"nobody has said what reading {reading_id} shows, so it teaches nothing",
                hint="answer it right or wrong first",
                state="unanswered",
            )
        picture = None if reading.crop is None else self._history.crops.surroundings(reading.crop)
        if picture is None:
            raise NotPossibleNow(
                f"no picture is kept of the plate around {reading.object}, from which its look could be taught",
                hint="use `panelwright learn`, which takes an overview of the whole panel",
                state="no-picture",
            )
        return reading, picture

    def _final(self, reading: StoredReading, verdict: Verdict, shows: dict[str, Any]) -> dict[str, Any]:
        """Return what the reading shows by an answer."""
        if verdict != "wrong" and shows:
            raise InvalidRequest(f"the verdict {verdict} comes without {', '.join(shows)}", hint="leave that out")
        if verdict == "unreadable":
            return {}
        if verdict == "right":
            read = {key: item for key in FIELDS if (item := getattr(reading, key)) is not None} or held_by(reading)
            if not read:
                raise InvalidRequest(
                    "this reading shows nothing that could be right", hint="answer wrong or unreadable"
                )
            return read
        _check_shown(self._panel.object(reading.object), shows)
        return shows


def held_by(reading: StoredReading) -> dict[str, Any]:
    """Return what a refusal holds back: value, state or text; empty if nothing."""
    held = {} if reading.guess is None else json.loads(reading.guess)["held"]
    return {key: item for key, item in held.items() if key in FIELDS}


def _check_shown(panel_object: PanelObject, shows: dict[str, Any]) -> None:
    """Raise `InvalidRequest` for what an object cannot show."""
    if not shows:
        raise InvalidRequest("the verdict wrong says what the object shows", hint="give value, state or text")
    states, name = panel_object.states_shown, panel_object.name
    if states and (set(shows) != {"state"} or shows["state"] not in states):
        raise InvalidRequest(f"{name} shows one of its states", hint=f"give state: {', '.join(states)}")
    if not states and "state" in shows:
        raise InvalidRequest(f"{name} shows no state", hint="give value or text")
