"""Decides from the readings of one object which of its alarm conditions hold.

A refused or stale reading decides nothing about the limits: their conditions stay as they were, and an alarm of its own is
raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from hal.panel import PanelObject
from hal.panel.limits import Limits, unit_of
from service.history.reading import StoredReading

INTERVAL_SIGMAS = 1.96  # an interval that holds the true value in 95 % of cases
LIMIT_WORDS = {"low_low": "below low-low", "low": "below low", "high": "above high", "high_high": "above high-high"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Whether a condition holds; `says` tells it as a sentence, and `straddles` that the interval reaches over the limit."""

    holds: bool
    says: str = ""
    straddles: bool = False


@dataclass(slots=True, kw_only=True)
class Watch:
    """What is remembered about one object between two readings.

    Attributes:
        panel_object: the object of the panel file, with its limits.
        valid_at_s: when it was read validly last, or since when it has been watched; on the desk's clock.
        beyond_since_s: since when its value has been beyond each limit.
        doubts: sentences about limits that the newest interval straddles without an alarm, by limit.
    """

    panel_object: PanelObject
    valid_at_s: float
    beyond_since_s: dict[str, float] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    _last: StoredReading | None = None
    _verdicts: dict[str, Verdict] = field(default_factory=dict)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of alarm that the object can have; empty when the panel file asks for none."""
        one, limits = self.panel_object, self.panel_object.limits
        kinds = [] if limits is None else [*limits.given, *(["rate"] if limits.rate_per_s is not None else [])]
        kinds += ["state"] if one.normal is not None else []
        kinds += ["stale"] if one.stale_after_s is not None else []
        return (*kinds, "refused") if kinds else ()

    def takes(self, reading: StoredReading, now_s: float, is_active: Callable[[str], bool]) -> dict[str, Verdict]:
        """Return a verdict on each condition that this reading decides.

        Args:
            now_s: on the desk's clock.
            is_active: whether the condition of a kind holds up to now, which the deadband needs.
        """
        if not reading.is_valid:
            shown = reading.text or reading.state
            told = f"{reading.object} cannot be read: {reading.cause}" + (f" (shows {shown})" if shown else "")
            return {"refused": Verdict(holds=True, says=told)}
        verdicts = {"refused": Verdict(holds=False)}
        self.valid_at_s = now_s
        limits = self.panel_object.limits
        if limits is not None and reading.value is not None:
            verdicts |= self._by_limits(limits, reading, reading.value, now_s, is_active)
            if limits.rate_per_s is not None:
                verdicts["rate"] = self._by_rate(limits.rate_per_s, reading, reading.value)
        if self.panel_object.normal is not None:
            verdicts["state"] = self._by_state(self.panel_object.normal, reading)
        self._last = reading
        return verdicts | self.passes(now_s)

    def passes(self, now_s: float) -> dict[str, Verdict]:
        """Return the verdicts that the time alone decides: delays that are over, and readings that are too old."""
        limits, stale_after_s = self.panel_object.limits, self.panel_object.stale_after_s
        verdicts: dict[str, Verdict] = {}
        for kind, since_s in self.beyond_since_s.items():
            if limits is not None and now_s - since_s >= limits.delay_s:
                verdicts[kind] = self._verdicts[kind]
        if stale_after_s is not None:
            age_s = now_s - self.valid_at_s
            told = f"{self.panel_object.name} was not read validly for more than {stale_after_s:g} s"
            verdicts["stale"] = Verdict(holds=age_s > stale_after_s, says=told)
        return verdicts

    def _by_limits(
        self, limits: Limits, reading: StoredReading, value: float, now_s: float, is_active: Callable[[str], bool]
    ) -> dict[str, Verdict]:
        verdicts: dict[str, Verdict] = {}
        self.doubts.clear()
        for kind, limit in limits.given.items():
            outward = 1.0 if kind.startswith("high") else -1.0
            excess = outward * (value - limit)
            beyond = excess > (-limits.deadband if is_active(kind) else 0.0)
            half = INTERVAL_SIGMAS * (reading.sigma or 0.0)
            straddles = abs(excess) < half
            told = self._told(kind, limit, value, half if straddles else 0.0, is_beyond=excess > 0.0)
            if not beyond:
                self.beyond_since_s.pop(kind, None)
                verdicts[kind] = Verdict(holds=False)
                if straddles:
                    self.doubts[kind] = told
                continue
            self.beyond_since_s.setdefault(kind, now_s)
            self._verdicts[kind] = Verdict(holds=True, says=told, straddles=straddles)
        return verdicts

    def _told(self, kind: str, limit: float, value: float, half: float, *, is_beyond: bool) -> str:
        one, unit = self.panel_object, unit_of(self.panel_object)
        place = LIMIT_WORDS[kind] if is_beyond else f"within {kind.replace('_', '-')}"
        told = f"{one.name} shows {value:.4g} {unit}".rstrip() + f", {place} {limit:g}"
        if half > 0.0:
            told += f"; its interval {value - half:.4g} to {value + half:.4g} straddles that limit"
        return told

    def _by_rate(self, most_per_s: float, reading: StoredReading, value: float) -> Verdict:
        """Judge the change since the reading before, on the cell's clock; the first reading of a run has no rate."""
        last = self._last
        if last is None or last.value is None or reading.cell_s <= last.cell_s:
            return Verdict(holds=False)
        span_s = reading.cell_s - last.cell_s
        rate = abs(value - last.value) / span_s
        half = INTERVAL_SIGMAS * ((reading.sigma or 0.0) ** 2 + (last.sigma or 0.0) ** 2) ** 0.5 / span_s
        unit = unit_of(self.panel_object)
        told = f"{reading.object} changed by {rate:.3g} {unit}/s, more than {most_per_s:g}"
        return Verdict(holds=rate > most_per_s, says=told, straddles=abs(rate - most_per_s) < half)

    def _by_state(self, normal: tuple[str, ...], reading: StoredReading) -> Verdict:
        told = f"{reading.object} is {reading.state}, which is not normal ({', '.join(normal)})"
        return Verdict(holds=reading.state not in normal, says=told)
