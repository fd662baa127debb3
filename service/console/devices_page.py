"""Every device with what it says now: newest value, rate, age, faults, and connecting it again."""

from __future__ import annotations

import math
from typing import Any

from nicegui import ui

from hal.errors import CellError
from service.access.keys import Role
from service.console.device_form import DeviceDialog
from service.console.mirror import Mirror
from service.console.page_frame import Place, attempt, live, page_frame, picks, table
from service.console.service_client import QUICK_S
from service.console.texts import say
from service.console.values import attribute

READ_S = 1.0
UNITS = {"m": "m", "n": "N", "nm": "N m", "rad": "rad", "s": "s"}
PICTURES = ("camera", "range_scanner")


def install(place: Place) -> None:
    """Add the page at `/devices`."""

    @ui.page("/devices", title=f"{say('nav.devices')} · {say('title')}")
    def devices_page() -> None:
        mirror = place.mirror
        values, dialog = _Values(mirror), DeviceDialog(mirror)

        async def connect(name: str) -> None:
            if await attempt(lambda: mirror.client.post(f"/v1/devices/{name}/connect")) is not None:
                ui.notify(say("device.connected", name=name), type="positive")
            mirror.hurry()

        with page_frame(place, "devices"), ui.element("section").classes("card"):
            ui.html(say("devices.heading"), sanitize=False, tag="h2")
            listed = ui.html("", sanitize=False).classes("stack")
            live(picks(picks(listed, connect, what="connect"), dialog.show, what="swap"), values.table)
            live(
                ui.html("", sanitize=False, tag="p").classes("quiet"),
                lambda: say("devices.sim") if is_sim(mirror) else "",
            )
        ui.timer(READ_S, values.read)


class _Values:
    """The newest value of each device and how fast its readings come; read only while the page is open."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._readings: dict[str, dict[str, Any]] = {}
        self._rates_hz: dict[str, float] = {}

    async def read(self) -> None:
        """Read each device that has values, at most a second old."""
        for device in self._mirror.said("devices", {"devices": []})["devices"]:
            name = device["name"]
            if device["kind"] in PICTURES or not device["health"]["connected"]:
                continue
            try:
                path = f"/v1/devices/{name}/reading?max_age_s={READ_S}"
                fresh = await self._mirror.client.get(path, timeout_s=QUICK_S)
            except CellError:
                self._readings.pop(name, None)
                continue
            before = self._readings.get(name)
            if before is not None:
                passed_s = fresh["host_time_s"] - before["host_time_s"]
                counted = fresh["sequence"] - before["sequence"]
                self._rates_hz[name] = counted / passed_s if passed_s > 0.0 else 0.0
            self._readings[name] = fresh

    def table(self) -> str:
        """Return all devices as an HTML table."""
        devices = self._mirror.said("devices", {"devices": []})["devices"]
        columns = ["device", "kind", "driver", "quality", "newest", "rate", "age", "fault"]
        return table(columns, [self._row(device) for device in devices], name=say("devices.heading"))

    def _row(self, device: dict[str, Any]) -> str:
        name, health = device["name"], device["health"]
        reading, rate_hz = self._readings.get(name), self._rates_hz.get(name)
        is_good = health["connected"] and health["quality"] == "valid"
        quality = say("device.good") if is_good else health["quality"] if health["connected"] else say("device.gone")
        fault = health["detail"] or ("" if health["cause"] == "none" else health["cause"])
        counts = say("device.errors", errors=health["errors"], reconnects=health["reconnects"])
        again = "" if health["connected"] or not self._mirror.may(Role.OPERATOR) else (
            f'<button type="button" class="plain" data-connect="{name}">{say("device.connect")}</button>'
        )  # fmt: skip
        if self._mirror.may(Role.MAINTAINER):
            label = attribute(say("device.swap.heading", name=name))
            again += f' <button type="button" class="plain" data-swap="{name}" aria-label="{label}">{say("device.swap")}</button>'
        value = "–" if reading is None else shown_value(device["kind"], reading["value"])
        if device["kind"] in PICTURES:
            value = say("device.picture")
        aged = "–" if reading is None or reading["age_s"] is None else f"{reading['age_s']:.2f} s"
        return (
            f"<tr><td><b>{attribute(name)}</b></td><td>{attribute(device['kind'].replace('_', ' '))}</td>"
            f'<td class="quiet" data-head="{say("column.driver")}">{attribute(device["driver"])}</td>'
            f'<td class="{"good" if is_good else "bad"}">{attribute(quality)}</td><td>{attribute(value)}</td>'
            f'<td data-head="{say("column.rate")}">{attribute(self._rate(device, rate_hz))}</td>'
            f'<td data-head="{say("column.age")}" style="white-space:nowrap">{aged}</td>'
            f'<td>{attribute(fault)} <span class="quiet">{counts}</span> {again}</td></tr>'
        )

    def _rate(self, device: dict[str, Any], rate_hz: float | None) -> str:
        """Return how fast readings come, on the cell's clock, or why there is no such number."""
        if device["kind"] in PICTURES:
            return say("device.on_demand")
        if rate_hz is None:
            return "–"
        if rate_hz > 0.0:
            return say("device.rate", rate=f"{rate_hz:.0f}")
        return say("device.clock_stands" if is_sim(self._mirror) else "device.no_rate")


def is_sim(mirror: Mirror) -> bool:
    """Return whether the whole cell is simulated."""
    info = mirror.said("info")
    return info is not None and info["mode"] == "sim"


def shown_value(kind: str, value: Any) -> str:
    """Return a device's value with its units and the names of its parts, which a bare number or list does not carry."""
    if kind == "proximity" and value is None:
        return say("device.nothing_near")
    if kind == "proximity" and isinstance(value, int | float):
        return say("device.distance", distance=f"{value:.3f}")
    if kind == "touch" and isinstance(value, list) and len(value) == 2:
        left, right = (say("device.touched" if one else "device.free") for one in value)
        return say("device.touch", left=left, right=right)
    if kind == "lights" and isinstance(value, list):
        return say("device.lights", states=" ".join(say("device.on" if one else "device.off") for one in value))
    return in_words(value)


def in_words(value: Any) -> str:
    """Return a device's value as short text: numbers to four digits, angles of joints in degrees."""
    if isinstance(value, dict):
        if "position_rad" in value:
            return " ".join(f"{math.degrees(angle):.1f}°" for angle in value["position_rad"])
        return ", ".join(_named(key, part) for key, part in value.items())[:160]
    if isinstance(value, bool):
        return say("yes" if value else "no")
    if isinstance(value, list):
        return " ".join(in_words(part) for part in value)[:160]
    return f"{value:.4g}" if isinstance(value, float) else "–" if value is None else str(value)


def _named(key: str, value: Any) -> str:
    """Return one part of a value with its name and, behind the number, its unit."""
    name, _, unit = key.rpartition("_")
    if unit in UNITS:
        return f"{name.replace('_', ' ')} {in_words(value)} {UNITS[unit]}"
    return f"{key.removeprefix('is_').replace('_', ' ')} {in_words(value)}"
