"""The limits of one object: shows them, and lets a maintainer set others, by which its newest reading is judged at once."""

from __future__ import annotations

import math
from typing import Any

from nicegui import ui

from hal.panel import PanelObject
from hal.panel.limits import ORDER, Limits
from service.access.keys import Role
from service.console.mirror import Mirror
from service.console.page_frame import attempt, button
from service.console.texts import say
from service.console.trend_chart import unit_for_people
from service.console.values import attribute, label_of


class LimitsForm:
    """The part of a dialog that is about limits; `show` prepares it for an object, and shows nothing for one without a value."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._holder = ui.element("div")

    def show(self, one: PanelObject) -> None:
        """Show the limits of an object, with a button to set others."""
        self._holder.clear()
        if one.full_scale is None and not one.value_is_angle:
            return
        with self._holder, ui.element("div").classes("row"):
            ui.html(attribute(told_limits(one)), sanitize=False, tag="p").classes("quiet")
            if self._mirror.may(Role.MAINTAINER):
                button(say("limits.set"), lambda: self._ask(one), look="plain")

    def _ask(self, one: PanelObject) -> None:
        """Show a field for each limit."""
        self._holder.clear()
        given = {} if one.limits is None else one.limits.given
        with self._holder:
            with ui.element("div").classes("fields").props(f'role=group aria-label="{say("limits.heading")}"'):
                fields = {
                    name: ui.number(
                        label=say(f"limits.{name}", unit=unit_for_people(one)),
                        value=None if name not in given else round(given[name] * _factor(one), 6),
                    ).props("outlined dense clearable")
                    for name in ORDER
                }
            told = ui.html("", sanitize=False, tag="p").classes("bad").props("role=status")

            async def save() -> None:
                numbers = {name: float(field.value) for name, field in fields.items() if field.value is not None}
                if not numbers:
                    told.set_content(attribute(say("limits.none_given")))
                    return
                if await self._send("PUT", one, body_of(one, numbers)):
                    self._done(one)

            async def reset() -> None:
                if await self._send("DELETE", one, None):
                    self._done(one)

            with ui.element("div").classes("row"):
                button(say("limits.save"), save)
                button(say("limits.reset"), reset, look="plain")
                button(say("object.no"), lambda: self.show(one), look="plain")

    async def _send(self, method: str, one: PanelObject, body: dict[str, Any] | None) -> bool:
        sent = await attempt(lambda: self._mirror.client.fetch(method, f"/v1/limits/{one.name}", body))
        if sent is not None:
            await self._mirror.ask_now("panel", "alarms")
        return sent is not None

    def _done(self, one: PanelObject) -> None:
        ui.notify(say("limits.saved", label=label_of(one)), type="positive")
        panel = self._mirror.panel
        if panel is not None:
            self.show(panel.object(one.name))


def told_limits(one: PanelObject) -> str:
    """Return the limits of an object in words."""
    if one.limits is None or not one.limits.given:
        return say("limits.none")
    parts = [f"{name.replace('_', '-')} {value * _factor(one):g}" for name, value in one.limits.given.items()]
    return say("limits.told", limits=", ".join(parts), unit=unit_for_people(one)).replace(" .", ".")


def body_of(one: PanelObject, numbers: dict[str, float]) -> dict[str, float]:
    """Return limits as the API takes them; what the form does not ask for stays as it is."""
    kept = {} if one.limits is None else one.limits.model_dump(exclude_none=True)
    kept = {key: value for key, value in kept.items() if key in Limits.model_fields and key not in ORDER}
    return {**kept, **{name: value / _factor(one) for name, value in numbers.items()}}


def _factor(one: PanelObject) -> float:
    return math.degrees(1.0) if one.value_is_angle else 1.0
