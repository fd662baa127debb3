"""Values over time as a chart of ECharts: a line for each object, its confidence band, and its limits."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from hal.panel import PanelObject
from service.console.texts import say
from service.console.values import label_of

INTERVAL_SIGMAS = 1.96  # an interval that holds the true value in 95 % of cases
COLOURS = ("#2f7fd0", "#c0571f", "#2a8f5f", "#8a5fc0", "#b03a6a", "#7c7a1c")
INK = "#7d8a97"  # is readable on the light and on the dark ground
ZOOMS: dict[str, dict[str, Any]] = {"inside": {}, "slider": {"bottom": 20, "textStyle": {"color": INK}}}
SERIES_PER_TREND = 3
ROOM = 0.08  # of the shown values, above and below them


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One reading, or the readings of one span of time.

    Attributes:
        at_s, since_s, until_s: seconds since 1970; the three are equal for one reading.
        low, high: the 95 % interval of one reading, or the least and greatest value of a span.
        crop_url: the picture of one reading.
    """

    at_s: float
    value: float
    low: float
    high: float
    since_s: float
    until_s: float
    crop_url: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """The points of one object, in its unit for people."""

    panel_object: PanelObject
    points: tuple[Point, ...]


def of_readings(one: PanelObject, readings: Sequence[dict[str, Any]]) -> Trend:
    """Return the trend of single readings; refused ones have no value and so no point."""
    factor = _factor(one)
    points = []
    for row in readings:
        if row["quality"] != "valid" or row["value"] is None:
            continue
        half = INTERVAL_SIGMAS * (row["sigma"] or 0.0)
        value, low, high = (factor * v for v in (row["value"], row["value"] - half, row["value"] + half))
        at_s = row["utc_s"]
        point = Point(at_s=at_s, value=value, low=low, high=high, since_s=at_s, until_s=at_s, crop_url=row["crop_url"])
        points.append(point)
    return Trend(panel_object=one, points=tuple(points))


def of_buckets(one: PanelObject, buckets: Sequence[dict[str, Any]]) -> Trend:
    """Return the trend of spans of time; spans in which only refused readings were made have no point."""
    factor = _factor(one)
    points = tuple(
        Point(
            at_s=(span["since_s"] + span["until_s"]) / 2,
            value=factor * span["mean"],
            low=factor * span["minimum"],
            high=factor * span["maximum"],
            since_s=span["since_s"],
            until_s=span["until_s"],
        )
        for span in buckets
        if span["mean"] is not None
    )
    return Trend(panel_object=one, points=points)


def unit_for_people(one: PanelObject) -> str:
    """Return the unit of an object's values as it is shown."""
    if one.value_is_angle:
        return "°"
    return str(getattr(getattr(one, "scale", None), "unit", "") or getattr(one, "unit", "")).replace("degC", "°C")


def options_of(trends: Sequence[Trend]) -> dict[str, Any]:
    """Return the options of the chart; the series of a trend are `SERIES_PER_TREND` in a row."""
    units = list(dict.fromkeys(unit_for_people(trend.panel_object) for trend in trends))
    series = [
        one for k, trend in enumerate(trends) for one in _series(trend, COLOURS[k % len(COLOURS)], _axis(trend, units))
    ]
    return {
        "textStyle": {"color": INK},
        "animation": False,
        "grid": {"left": 60, "right": 30 + 50 * max(len(units) - 1, 0), "top": 50, "bottom": 80},
        "legend": {"data": [label_of(trend.panel_object) for trend in trends], "textStyle": {"color": INK}, "top": 0},
        "tooltip": {"trigger": "item"},
        "xAxis": {"type": "time", "axisLabel": {"color": INK, "hideOverlap": True}},
        "yAxis": [_y_axis(unit, k, trends) for k, unit in enumerate(units)],
        "dataZoom": [{"type": kind, "filterMode": "none", **place} for kind, place in ZOOMS.items()],
        "series": series,
    }


def _y_axis(unit: str, number: int, trends: Sequence[Trend]) -> dict[str, Any]:
    side = "left" if number == 0 else "right"
    shown = [edge for trend in trends if unit_for_people(trend.panel_object) == unit for edge in _reach(trend)]
    room = ROOM * (max(shown) - min(shown)) or 1.0 if shown else 1.0
    ends = {"min": min(shown) - room, "max": max(shown) + room} if shown else {}
    told: dict[str, Any] = {"name": unit, "nameTextStyle": {"color": INK}, "type": "value"}
    told["axisLabel"] = {"color": INK, "showMinLabel": False, "showMaxLabel": False}
    return {
        **told,
        **ends,
        "position": side,
        "offset": 50 * max(number - 1, 0),
        "splitLine": {"lineStyle": {"opacity": 0.25}},
    }


def _reach(trend: Trend) -> list[float]:
    """Return the values that an axis must reach: the bands, and the nearest limit on each side of them."""
    if not trend.points:
        return []
    least, greatest = min(point.low for point in trend.points), max(point.high for point in trend.points)
    one = trend.panel_object
    limits = [_factor(one) * value for value in one.limits.given.values()] if one.limits is not None else []
    below, above = [v for v in limits if v < least], [v for v in limits if v > greatest]
    return [least, greatest, *([max(below)] if below else []), *([min(above)] if above else [])]


def _axis(trend: Trend, units: list[str]) -> int:
    return units.index(unit_for_people(trend.panel_object))


def _series(trend: Trend, colour: str, axis: int) -> Iterator[dict[str, Any]]:
    """Yield the lower edge of the band, the band upon it, and the line with the limits."""
    one = trend.panel_object
    shared = {"type": "line", "yAxisIndex": axis, "itemStyle": {"color": colour}}
    unseen = {**shared, "stack": one.name, "stackStrategy": "all", "silent": True, "symbol": "none"}
    edge = {**unseen, "lineStyle": {"opacity": 0}, "tooltip": {"show": False}}
    # ECharts ends its zoom at whole milliseconds, and draws no point that lies a fraction beyond it.
    whole_ms = [round(1e3 * point.at_s) for point in trend.points]
    yield {**edge, "data": [[at_ms, point.low] for at_ms, point in zip(whole_ms, trend.points, strict=True)]}
    band = [[at_ms, point.high - point.low] for at_ms, point in zip(whole_ms, trend.points, strict=True)]
    yield {**edge, "areaStyle": {"color": colour, "opacity": 0.22}, "data": band}
    yield {
        **shared,
        "name": label_of(one),
        "symbolSize": 9,
        "lineStyle": {"color": colour},
        "data": [[at_ms, round(point.value, 6)] for at_ms, point in zip(whole_ms, trend.points, strict=True)],
        "markLine": {"symbol": "none", "silent": True, "data": list(_limits(one, colour, is_left=axis % 2 == 1))},
    }


def _limits(one: PanelObject, colour: str, *, is_left: bool) -> Iterator[dict[str, Any]]:
    for name, value in one.limits.given.items() if one.limits is not None else ():
        told = say("history.limit", label=label_of(one), limit=name.replace("_", "-"))
        label = {"formatter": told, "position": "insideStartBottom" if is_left else "insideEndTop", "color": INK}
        yield {"yAxis": _factor(one) * value, "label": label, "lineStyle": {"color": colour, "type": "dashed"}}


def _factor(one: PanelObject) -> float:
    """Return what a stored value is multiplied by for people, who read angles in degrees."""
    return math.degrees(1.0) if one.value_is_angle else 1.0
