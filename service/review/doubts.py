"""Decides which readings a person should look at: refused, below the cell's sure line, or contradicted by earlier ones."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from hal.panel import Panel
from service.history.reading import AUDIT, StoredReading

COUNTER = "counter"
SIGMAS = 1.96  # of the 95 % interval


class Doubts:
    """Compares each reading with the cell's sure line and with the reading before it.

    The reading before counts even if it was doubted itself, so that one misread does not make all later ones doubtful.

    Args:
        sure_at: least confidence of a reading that is sure.
        audit_share: share of the sure readings that are drawn for an audit.
        earlier: the newest readings, for the start.
        draw: returns a number from 0 to 1 for each sure reading.
    """

    def __init__(
        self,
        panel: Panel,
        *,
        sure_at: float,
        audit_share: float = 0.0,
        earlier: Iterable[StoredReading] = (),
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._rates = {one.name: one.limits.rate_per_s for one in panel.objects if one.limits is not None}
        self._sure_at, self._audit_share, self._draw = sure_at, audit_share, draw
        self._last = {reading.object: reading for reading in earlier if reading.is_valid}

    def of(self, reading: StoredReading) -> str:
        """Return why a person should look at a reading, as a sentence; empty if it is sure."""
        if not reading.is_valid:
            return f"it was refused: {reading.cause}"
        last, self._last[reading.object] = self._last.get(reading.object), reading
        if reading.confidence < self._sure_at:
            return f"its confidence is {reading.confidence:.2f}, below the sure line of {self._sure_at:g}"
        told = "" if last is None else self._contradiction(reading, last)
        return told or (AUDIT if self._draw() < self._audit_share else "")

    def _contradiction(self, reading: StoredReading, last: StoredReading) -> str:
        if reading.value is None or last.value is None:
            return ""
        change = reading.value - last.value
        half = SIGMAS * ((reading.sigma or 0.0) ** 2 + (last.sigma or 0.0) ** 2) ** 0.5
        if reading.kind == COUNTER and change < -half:
            return f"the counter went back from {last.value:g} to {reading.value:g}"
        most, span_s = self._rates.get(reading.object), reading.utc_s - last.utc_s
        if most is not None and span_s > 0.0 and abs(change) - half > most * span_s:
            return f"it changed by {change:.4g} {reading.unit} in {span_s:.0f} s, faster than {most:g} per second"
        return ""
