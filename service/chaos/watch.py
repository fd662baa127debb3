"""Watches from outside that the arm rests while the stop is latched."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hal.errors import CellError
from service.chaos.plant import Plant
from service.processes.latch import StopLevel

EVERY_S = 0.2
REST_S = 3.0  # after a stop: a simulated arm of a busy machine needs this long to come to rest
BACK_S = 8.0  # more, if the stop lets it go back the way it came (`service_lost` of the cell file)
STILL_RAD = 0.003  # noise and sag


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """The arm at one moment.

    Attributes:
        at_s: monotonic time.
        stop: what stays the same as long as the stop stays latched; None while it is clear.
        rest_s: the time after which the arm must have come to rest.
    """

    at_s: float
    stop: tuple[Any, ...] | None
    position_rad: tuple[float, ...]
    rest_s: float = REST_S


def motions_while_latched(sights: Sequence[Sight]) -> list[str]:
    """Return a sentence for each latched stop under which the arm moved after it had had the time to come to rest."""
    found: list[str] = []
    first: Sight | None = None  # of this stop
    rest: Sight | None = None  # the first one at rest under it
    for sight in sights:
        if sight.stop is None or first is None or first.stop != sight.stop:
            first, rest = sight if sight.stop is not None else None, None
            continue
        if sight.at_s - first.at_s < sight.rest_s:
            continue
        if rest is None:
            rest = sight
            continue
        moved = max(abs(a - b) for a, b in zip(rest.position_rad, sight.position_rad, strict=True))
        if moved > STILL_RAD:
            found.append(f"a joint moved by {1e3 * moved:.1f} mrad while the stop was latched")
            first = rest = None
    return found


@dataclass(slots=True, kw_only=True, eq=False)
class Watch:
    """Samples the stop and the joints in a thread.

    Attributes:
        arm: name of the arm in the cell file.
    """

    plant: Plant
    arm: str
    sights: list[Sight] = field(default_factory=list)
    _is_ending: threading.Event = field(default_factory=threading.Event)

    def begin(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._run, daemon=True).start()

    def end(self) -> None:
        """End the thread."""
        self._is_ending.set()

    def take(self) -> list[Sight]:
        """Return the samples so far, and begin anew."""
        taken, self.sights = self.sights, []
        return taken

    def _run(self) -> None:
        while not self._is_ending.wait(EVERY_S):
            sight = self._look()
            if sight is not None:
                self.sights.append(sight)

    def _look(self) -> Sight | None:
        """Return the arm between two equal looks at the stop; None when somebody does not answer or the stop changed."""
        try:
            before = self._stop()
            reading = self.plant.client(2.0).get(f"/v1/devices/{self.arm}/reading")
            position = tuple(float(q) for q in _joints(reading))
            after = self._stop()
        except (CellError, KeyError, TypeError, ValueError):
            return None
        if before != after:
            return None
        rest_s = REST_S + (BACK_S if before is not None and before[-1] == StopLevel.RETREAT else 0.0)
        return Sight(at_s=time.monotonic(), stop=before, position_rad=position, rest_s=rest_s)

    def _stop(self) -> tuple[Any, ...] | None:
        """Return life, cell process, count and level of a latched stop: a new simulated world begins elsewhere."""
        stop = self.plant.stop_client(1.0).get("/v1/stop")
        if not stop["is_latched"]:
            return None
        roles = self.plant.roles()
        return (self.plant.life, roles.get("cell"), roles.get("world"), stop["count"], stop["level"])


def _joints(reading: Any) -> Iterable[Any]:
    value = reading["value"]
    return list(value["position_rad"])
