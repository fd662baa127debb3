"""The lines that the supervisor and the cell process send each other over a private pipe."""

from __future__ import annotations

import base64
import json
import pickle
from dataclasses import dataclass
from typing import Any

from hal.config import LossAction
from hal.errors import CellError
from service.processes.beat import SILENCE_S

NOTE = "note "  # prefix of a line that goes into the journal
MISSING = "device-missing"  # kind of the note that says that the cell runs without this device
BLOCKED = "control-blocked"  # kind of the note that the control thread does not come back; `why` says how long
LOST = "cell-lost"  # kind of the note with which a cell ends that lost something it cannot run without


@dataclass(frozen=True, slots=True, kw_only=True)
class CellOrder:
    """The start parameters that the supervisor sends to a new cell process over a private pipe."""

    cell_path: str
    seed: int | None
    folder: str
    address: str
    authkey: str
    runs_dir: str | None
    partial: bool
    swapped: dict[str, dict[str, Any]]
    service_lost: LossAction = "stop"
    record: tuple[str, str] | None = None
    silence_s: float = SILENCE_S

    def to_line(self) -> str:
        """Return the order as one line of JSON."""
        return json.dumps({name: getattr(self, name) for name in self.__slots__})

    @classmethod
    def from_line(cls, line: str) -> CellOrder:
        """Read an order from one line of JSON, the inverse of `to_line`."""
        return cls(**json.loads(line))


def error_to_line(error: CellError) -> str:
    """Encode an error as one line for the supervisor."""
    return "error " + base64.b64encode(pickle.dumps(error)).decode()


def error_from_line(line: str) -> CellError:
    """Decode a line of `error_to_line`. It is unpickled, so it must come from our own child process."""
    error: CellError = pickle.loads(base64.b64decode(line.removeprefix("error ")))  # noqa: S301 - our own child
    return error


def note_to_line(kind: str, data: dict[str, Any]) -> str:
    """Encode an entry for the journal as one line for the supervisor."""
    return NOTE + json.dumps([kind, data])


def note_from_line(line: str) -> tuple[str, dict[str, Any]] | None:
    """Decode a line of `note_to_line`; None for any other line."""
    if not line.startswith(NOTE):
        return None
    kind, data = json.loads(line.removeprefix(NOTE))
    return kind, data
