"""The metrics of a Sparkplug B device: the objects of the panel and their alarms, by name in a birth and by alias after it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from service.outlets.source import CellState, Changes, Instrument
from service.outlets.sparkplug_payload import DOUBLE, STRING, Metric

GOOD, BAD, STALE = 192, 0, 500  # values of the property Quality


class Device:
    """The device from one birth to the next.

    Args:
        instruments: the objects of the panel.
        now_ms: milliseconds since 1970.
    """

    def __init__(self, instruments: Sequence[Instrument], *, now_ms: Callable[[], int]) -> None:
        self._instruments = {one.name: one for one in instruments}
        self._now_ms = now_ms
        self._aliases: dict[str, int] = {}
        self._newest_ms: dict[str, int] = {}

    def birth(self, state: CellState) -> list[Metric]:
        """Return all metrics with name and alias."""
        metrics = [self._reading(name, state.readings.get(name)) for name in self._instruments]
        metrics += [self._alarm(alarm) for alarm in state.alarms.values()]
        self._aliases = {str(one.name): k for k, one in enumerate(metrics)}
        return [replace(one, alias=k, is_historical=False) for k, one in enumerate(metrics)]

    def changes(self, found: Changes) -> list[Metric]:
        """Return changes by alias; what is older than what was told is historical."""
        known = [one for one in found.readings if one["object"] in self._instruments]
        named = [self._reading(one["object"], one) for one in known] + [self._alarm(one) for one in found.alarms]
        return [
            replace(one, name=None, alias=self._aliases[str(one.name)])
            for one in named
            if str(one.name) in self._aliases
        ]

    def _reading(self, name: str, reading: Mapping[str, Any] | None) -> Metric:
        one = self._instruments[name]
        told = {"engUnit": one.unit} if one.unit else {}
        scale = {} if one.low is None or one.high is None else {"engLow": one.low, "engHigh": one.high}
        kind = DOUBLE if one.low is not None else STRING
        if reading is None:  # it was never read
            return Metric(
                name=name,
                datatype=kind,
                value=None,
                at_ms=self._now_ms(),
                properties={**told, **scale, "Quality": STALE},
            )
        is_valid = reading["quality"] == "valid"
        value = reading["value"] if kind == DOUBLE else shown(reading)
        quality = {"Quality": GOOD if is_valid else BAD, "Sure": int(bool(reading["sure"]))}
        cause = {"Cause": reading["cause"]} if reading["cause"] else {}
        at_ms = round(1000 * reading["utc_s"])
        return Metric(
            name=name,
            datatype=kind,
            value=value if is_valid else None,
            at_ms=at_ms,
            is_historical=self._is_past(name, at_ms),
            properties={**told, **scale, **quality, **cause},
        )

    def _alarm(self, alarm: Mapping[str, Any]) -> Metric:
        name = "{}/alarm/{}".format(*alarm["id"].split("."))
        at_ms = round(1000 * alarm["changed_s"]) or self._now_ms()
        words = {"Active": int(bool(alarm["is_active"])), "Says": alarm["says"], "By": alarm["by"]}
        return Metric(
            name=name,
            datatype=STRING,
            value=alarm["state"],
            at_ms=at_ms,
            is_historical=self._is_past(name, at_ms),
            properties=words,
        )

    def _is_past(self, name: str, at_ms: int) -> bool:
        """Return whether something newer, or this, was told already."""
        is_past = at_ms <= self._newest_ms.get(name, -1)
        self._newest_ms[name] = max(at_ms, self._newest_ms.get(name, -1))
        return is_past


def shown(reading: Mapping[str, Any]) -> str | None:
    """Return what an object without a scale shows: its state, its text, or its number with the unit."""
    if reading["state"] is not None:
        return str(reading["state"])
    if reading["text"] is not None:
        return str(reading["text"])
    return None if reading["value"] is None else f"{reading['value']:g} {reading['unit']}".strip()
