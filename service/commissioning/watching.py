"""Collects what `panelwright devices watch` shows of a running service: values, rates, ages and error counters."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from hal.devices import DeviceKind
from hal.errors import CellError

PICTURES = (DeviceKind.CAMERA, DeviceKind.RANGE_SCANNER)
SHOWN: dict[DeviceKind, tuple[str, str, int]] = {  # key of the value, unit, decimals
    DeviceKind.ARM: ("position_rad", "rad", 3),
    DeviceKind.GRIPPER: ("width_m", "m", 4),
    DeviceKind.CAMERA: ("mean_level", "mean level", 1),
    DeviceKind.RANGE_SCANNER: ("median_depth_m", "m median", 3),
    DeviceKind.PROXIMITY: ("", "m", 4),
    DeviceKind.TOUCH: ("", "", 0),
    DeviceKind.FORCE_TORQUE: ("force_n", "N", 2),
    DeviceKind.LIGHTS: ("", "", 0),
}


class Asks(Protocol):
    """The part of a client that `Watch` needs."""

    def get(self, path: str) -> Any:
        """Return the JSON answer to a GET request."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The state of one device at one time; None where a value is not known.

    Attributes:
        health: `valid`, `degraded (cause)`, `disconnected`, and so on.
        rate_hz: samples per second since the previous row.
        errors_since: errors since the previous row.
    """

    name: str
    driver: str
    health: str
    value: str
    rate_hz: float | None
    age_s: float | None
    samples: int
    errors: int
    errors_since: int
    reconnects: int
    detail: str


class Watch:
    """Reads the state of all devices repeatedly.

    Args:
        with_pictures: whether to read cameras and range scanners too, which takes one picture each time.
        now_s: clock in seconds, from which rates are computed.
    """

    def __init__(
        self, client: Asks, *, with_pictures: bool = False, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._client = client
        self._with_pictures = with_pictures
        self._now_s = now_s
        self._before: dict[str, tuple[float, int, int]] = {}  # time, samples, errors

    def look(self) -> list[Row]:
        """Return the present state of every device.

        Raises:
            ApiError, DeviceUnavailable: the service does not answer.
        """
        return [self._row(view) for view in self._client.get("/v1/devices")["devices"]]

    def _row(self, view: dict[str, Any]) -> Row:
        health, name, kind = view["health"], view["name"], DeviceKind(view["kind"])
        now, samples, errors = self._now_s(), int(health["samples"]), int(health["errors"])
        before_s, samples_before, errors_before = self._before.get(name, (now, samples, errors))
        self._before[name] = now, samples, errors
        is_later = now > before_s and samples >= samples_before  # a device that was opened again counts from zero
        value, age_s = self._value(view, kind)
        return Row(
            name=name,
            driver=view["driver"],
            health=_health_word(health),
            value=value,
            rate_hz=(samples - samples_before) / (now - before_s) if is_later else None,
            age_s=age_s,
            samples=samples,
            errors=errors,
            errors_since=max(0, errors - errors_before),
            reconnects=int(health["reconnects"]),
            detail=health["detail"],
        )

    def _value(self, view: dict[str, Any], kind: DeviceKind) -> tuple[str, float | None]:
        """Return the newest value as short text and its age; after an error, the error in place of the value."""
        if kind in PICTURES and not self._with_pictures:
            return "", None
        try:
            reading = self._client.get(view["reading_url"])
        except CellError as error:
            return error.what, None
        if reading["quality"] == "invalid":
            return f"invalid ({reading['cause']})", reading["age_s"]
        return brief(kind, reading["value"]), reading["age_s"]


def _health_word(health: dict[str, Any]) -> str:
    if not health["connected"]:
        return "disconnected"
    cause = "" if health["cause"] == "none" else f" ({health['cause']})"
    return f"{health['quality']}{cause}"


def brief(kind: DeviceKind, value: Any) -> str:
    """Return a reading's value as short text with its unit."""
    key, unit, decimals = SHOWN[kind]
    told = value[key] if key else value
    numbers = told if isinstance(told, list) else [told]
    return f"{' '.join(_number(number, decimals) for number in numbers)} {unit}".strip()


def _number(number: Any, decimals: int) -> str:
    if isinstance(number, bool):
        return "on" if number else "off"
    if number is None or not math.isfinite(number):
        return "-"
    return f"{number:.{decimals}f}"
