"""What a batch gives, a JSON object a line: kept as it comes, so that a batch that is stopped can be gone on with."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hal.atomic_write import write_atomically
from hal.errors import InvalidRequest
from perception.range.recordings import Reading

PART = ".part"


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """What one recording gave: `scene` as `render.scene_json`, or `error` and no scene."""

    name: str
    scene: dict[str, Any] | None
    error: str | None


class KeptResults:
    """The results of a batch while it runs: lines added to OUT.part, which becomes OUT once all are there.

    The first line says what was asked, every other holds a result and the state of its recording when the batch began;
    so a second run takes over what still holds and nothing else.

    Attributes:
        part: path of OUT.part.
        goes_on: an earlier run has left results there.
    """

    def __init__(self, out: Path, folder: Path, reading: Reading, *, afresh: bool = False) -> None:
        """Open OUT.part, or begin it.

        Args:
            out: file for all results in the end.
            folder, reading: what is asked of this batch.
            afresh: forget what an earlier run left there.

        Raises:
            InvalidRequest: an earlier run left results of another folder or another reading.
        """
        self.part = out.with_name(out.name + PART)
        self._out = out
        self._asked = json.loads(json.dumps({"folder": str(folder.resolve()), "reading": asdict(reading)}))
        earlier = {} if afresh else self._written()
        self._lines = {
            name: line for name, line in earlier.items() if line["error"] is None
        }  # the others are tried again
        self.goes_on = bool(self._lines)
        self._stamps: dict[str, list[int]] = {}
        fresh = [json.dumps(self._asked), *(json.dumps(line) for line in self._lines.values())]
        write_atomically(self.part, _lines(fresh))  # without the line that an abrupt end may have cut

    def of(self, recordings: Iterable[Path]) -> dict[str, BatchResult]:
        """The earlier results that still hold, by name: those of unchanged recordings that gave a scene."""
        self._stamps = {path.name: _stamp(path) for path in recordings}
        lines = [line for name, line in self._lines.items() if line["stamp"] == self._stamps.get(name)]
        found = (BatchResult(name=line["name"], scene=line["scene"], error=line["error"]) for line in lines)
        return {result.name: result for result in found}

    @property
    def done(self) -> int:
        """Recordings of this batch with a result, taken over or new, by what is written: Ctrl-C parts it from any count."""
        return sum(line["stamp"] == self._stamps.get(name) for name, line in self._written().items())

    def add(self, results: Sequence[BatchResult]) -> None:
        """Keep the results of a task."""
        lines = [json.dumps({**asdict(result), "stamp": self._stamps[result.name]}) + "\n" for result in results]
        with self.part.open("a", encoding="utf-8") as file:
            file.write("".join(lines))

    def finish(self, results: Sequence[BatchResult]) -> None:
        """Write all results to OUT, in the order given, and drop what was kept on the way."""
        write_results(self._out, results)
        self.part.unlink()

    def _written(self) -> dict[str, dict[str, Any]]:
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
    """One JSON object a line: name, scene or error. Whole or not at all."""
    write_atomically(path, _lines(json.dumps(asdict(result)) for result in results))


def _lines(lines: Iterable[str]) -> str:
    return "\n".join(lines) + "\n"


def _stamp(path: Path) -> list[int]:
    state = path.stat()
    return [state.st_size, state.st_mtime_ns]


def _object(text: str) -> dict[str, Any] | None:
    """The object of a line; None for a line that an abrupt end has cut."""
    try:
        value = json.loads(text)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None
