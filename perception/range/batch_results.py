"""Results of a batch as a file with one JSON object per line, saved as they come, so that a batch can be resumed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hal.atomic_write import write_atomically
from hal.errors import InvalidRequest
from perception.range.recordings import Reading

PART = ".part"  # suffix of the file with the results of an unfinished batch


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """Result of one recording: `scene` as `render.scene_json` returns it, or `error` and no scene."""

    name: str
    scene: dict[str, Any] | None
    error: str | None


class KeptResults:
    """Results of a running batch, appended to the file OUT.part, which becomes OUT when the batch is complete.

    The first line holds the request (folder and reading). Each other line holds one result, and size and time of its
    recording at the start of the batch, so that a second run reuses only results of unchanged recordings.

    Attributes:
        part: path of OUT.part.
        goes_on: whether an earlier run has left results there.
    """

    def __init__(self, out: Path, folder: Path, reading: Reading, *, afresh: bool = False) -> None:
        """Open OUT.part, or create it.

        Args:
            out: file for all results in the end.
            folder, reading: request of this batch.
            afresh: drop the results of an earlier run.

        Raises:
            InvalidRequest: an earlier run with another folder or reading has left results there.
        """
        self.part = out.with_name(out.name + PART)
        self._out = out
        self._asked = json.loads(json.dumps({"folder": str(folder.resolve()), "reading": asdict(reading)}))
        earlier = {} if afresh else self._written()
        self._lines = {
            name: line for name, line in earlier.items() if line["error"] is None
        }  # recordings that failed are tried again
        self.goes_on = bool(self._lines)
        self._stamps: dict[str, list[int]] = {}
        fresh = [json.dumps(self._asked), *(json.dumps(line) for line in self._lines.values())]
        write_atomically(self.part, _lines(fresh))  # drops a last line that was cut off when the earlier run was killed

    def of(self, recordings: Iterable[Path]) -> dict[str, BatchResult]:
        """Return the earlier results that are still valid, by name: those of unchanged recordings that gave a scene."""
        self._stamps = {path.name: _stamp(path) for path in recordings}
        lines = [line for name, line in self._lines.items() if line["stamp"] == self._stamps.get(name)]
        found = (BatchResult(name=line["name"], scene=line["scene"], error=line["error"]) for line in lines)
        return {result.name: result for result in found}

    @property
    def done(self) -> int:
        """Number of recordings of this batch with a result, reused or new.

        It is counted in the file, because Ctrl-C may come between writing a result and counting it.
        """
        return sum(line["stamp"] == self._stamps.get(name) for name, line in self._written().items())

    def add(self, results: Sequence[BatchResult]) -> None:
        """Append the results of a task to OUT.part."""
        lines = [json.dumps({**asdict(result), "stamp": self._stamps[result.name]}) + "\n" for result in results]
        with self.part.open("a", encoding="utf-8") as file:
            file.write("".join(lines))

    def finish(self, results: Sequence[BatchResult]) -> None:
        """Write all results to OUT, in the given order, and delete OUT.part."""
        write_results(self._out, results)
        self.part.unlink()

    def _written(self) -> dict[str, dict[str, Any]]:
        """Return the complete result lines of OUT.part by name of the recording.

        Raises:
            InvalidRequest: they belong to another request.
        """
        if not self.part.exists():
            return {}
        asked, *lines = [_object(text) for text in self.part.read_text(encoding="utf-8").splitlines()] or [None]
        if lines and asked != self._asked:
            raise InvalidRequest(
                f"{self.part} holds what an earlier batch of another folder, or with other options, has done",
                hint="repeat that command to go on with it, give another --out, or --afresh to drop it",
            )
        return {line["name"]: line for line in lines if line is not None}


def write_results(path: Path, results: Sequence[BatchResult]) -> None:
    """Write one JSON object per line (name, scene or error); the file is written completely or not at all."""
    write_atomically(path, _lines(json.dumps(asdict(result)) for result in results))


def _lines(lines: Iterable[str]) -> str:
    """Join lines, with a newline after each."""
    return "\n".join(lines) + "\n"


def _stamp(path: Path) -> list[int]:
    """Return size and modification time of a file, by which a changed recording is recognised."""
    state = path.stat()
    return [state.st_size, state.st_mtime_ns]


def _object(text: str) -> dict[str, Any] | None:
    """Return the JSON object of a line; None if the line was cut off."""
    try:
        value = json.loads(text)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None
