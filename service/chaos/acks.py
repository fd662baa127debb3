"""A client of the service under test, which remembers every answer that it got, and looks for each in the journal."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.errors import CellError
from service.chaos.plant import Plant
from service.tasks.journal_reader import Record, read_records

BEAT_S = 0.4
ALL = 10**7


@dataclass(frozen=True, slots=True)
class Ack:
    """One acknowledged change: `key` is the task's id, the lease's holder, or the latch's count."""

    life: int
    kind: str
    key: str


@dataclass(slots=True, kw_only=True, eq=False)
class Acks:
    """Asks for changes of state and keeps what was acknowledged."""

    plant: Plant
    told: list[Ack] = field(default_factory=list)
    holder: str = ""
    _token: str = ""
    _is_silent: threading.Event = field(default_factory=threading.Event)
    _number: int = 0

    def headers(self) -> dict[str, str]:
        """Return the headers of a request by the holder of the lease, if there is one."""
        return {"Lease-Token": self._token} if self._token else {}

    def begin_task(self, verb: str, body: dict[str, object]) -> str:
        """Start a task; returns its id.

        Raises:
            CellError: it was refused.
        """
        task_id = str(self.plant.client().post(f"/v1/{verb}", body, headers=self.headers())["id"])
        self._note("task-queued", task_id)
        return task_id

    def stop(self, *, at_main_port: bool) -> None:
        """Stop, at the main port or at the stop port; the latter records without an acknowledgement.

        Raises:
            CellError: nobody answered.
        """
        if at_main_port:
            self._note("stop", str(self.plant.client().post("/v1/stop")["count"]))
        else:
            self.plant.stop_client().post("/v1/stop")

    def reset(self) -> None:
        """Reset the stop, with the count that is shown.

        Raises:
            CellError: it was refused.
        """
        seen = self.plant.client().get("/v1/stop")
        if seen["is_latched"]:
            self.plant.client().post("/v1/stop/reset", {"seen_count": seen["count"]}, headers=self.headers())
            self._note("stop-reset", str(seen["count"]))

    def take_lease(self) -> None:
        """Take the lease and keep it by heartbeats until `fall_silent` or `release`.

        Raises:
            CellError: it was refused.
        """
        self._number += 1
        holder = f"chaos-{self._number}"
        self._token = str(self.plant.client().post("/v1/lease", {"holder": holder})["token"])
        self._note("lease-acquired", holder)
        self.holder, self._is_silent = holder, threading.Event()
        threading.Thread(target=self._beat, args=(self._is_silent, self._token), daemon=True).start()

    def fall_silent(self) -> None:
        """Send no more heartbeats, as a client that hangs."""
        self._is_silent.set()

    def release(self) -> None:
        """Give the lease back, if there is one that still holds."""
        self.fall_silent()
        if self._token:
            with suppress(CellError):
                self.plant.client().post("/v1/lease/release", headers=self.headers())
        self._token = self.holder = ""

    def _beat(self, is_silent: threading.Event, token: str) -> None:
        while not is_silent.wait(BEAT_S):
            with suppress(CellError):
                self.plant.client(2.0).post("/v1/lease/heartbeat", headers={"Lease-Token": token})

    def _note(self, kind: str, key: str) -> None:
        self.told.append(Ack(self.plant.life, kind, key))

    def lost(self) -> list[Ack]:
        """Return the acknowledgements that the journal does not have.

        Raises:
            JournalError: the journal cannot be read.
        """
        return missing(self.told, read_records(journal_of(self.plant.runs), limit=ALL))


def journal_of(runs: Path) -> Path:
    """Return the journal of a folder of runs."""
    return runs / ".service" / "journal.sqlite"


def missing(told: Iterable[Ack], records: Iterable[Record]) -> list[Ack]:
    """Return the acknowledgements for which there is no record; each start of the service begins a life."""
    found: set[Ack] = set()
    life = 0
    for record in records:
        life += record.kind == "service-start"
        found.add(Ack(life, record.kind, _key_of(record.kind, record.data)))
    return [ack for ack in told if ack not in found]


def _key_of(kind: str, data: dict[str, Any]) -> str:
    match kind:
        case "task-queued":
            return str(data.get("task"))
        case "lease-acquired":
            return str(data.get("holder"))
        case _:
            return str(data.get("count"))
