"""Takes the alarms of one object out of service, for example while its instrument is repaired, and puts them back."""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import ui

from hal.panel import PanelObject
from service.access.keys import Role
from service.console.alarms_page import you_field
from service.console.mirror import Mirror
from service.console.page_frame import attempt, button
from service.console.texts import say
from service.console.values import attribute, label_of

OUT = "out-of-service"


class ServiceForm:
    """The part of a dialog that is about the service of an object's alarms; it shows nothing for an object without alarms."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._holder = ui.element("div").style("margin:.6rem 0")
        self._name = ""

    async def show(self, one: PanelObject) -> None:
        """Show whether the alarms of an object are in service, with a button that changes it for a maintainer."""
        self._name = one.name
        self._holder.clear()
        found = await attempt(lambda: self._mirror.client.get("/v1/alarms?all=true"))
        alarms = [alarm for alarm in (found or {"alarms": []})["alarms"] if alarm["object"] == one.name]
        if not alarms or self._name != one.name:
            return
        self._holder.clear()  # another answer may have come first
        out = [alarm for alarm in alarms if alarm["state"] == OUT]
        may = self._mirror.may(Role.MAINTAINER)
        with self._holder, ui.element("div").classes("row"):
            if out:
                told = say("object.out_of_service", by=out[0]["by"], reason=out[0]["reason"])
                ui.html(attribute(told), sanitize=False, tag="p").classes("warn")
            if may and len(out) < len(alarms):
                rest = [alarm["id"] for alarm in alarms if alarm["state"] != OUT]
                button(say("object.do.out-of-service"), lambda: self._ask(one, OUT, rest), look="plain")
            if may and out:
                back = [alarm["id"] for alarm in out]
                button(say("object.do.in-service"), lambda: self._ask(one, "in-service", back), look="plain")

    def _ask(self, one: PanelObject, deed: str, alarms: list[str]) -> None:
        """Ask who does it and why."""
        self._holder.clear()
        with self._holder:
            ui.html(attribute(say(f"object.ask.{deed}", label=label_of(one))), sanitize=False, tag="p")
            you = you_field(self._mirror)
            reason = ui.input(label=say("alarms.reason")).props("outlined dense maxlength=500")
            told = ui.html("", sanitize=False, tag="p").classes("bad").props("role=status")

            async def go() -> None:
                body = {"by": str(you.value or "").strip(), "reason": str(reason.value or "").strip()}
                lacking = [key for key, given in body.items() if not given]
                if lacking:
                    told.set_content(attribute(say(f"alarms.{'you' if 'by' in lacking else 'reason'}.missing")))
                    return
                await self._send(deed, alarms, body)
                await self.show(one)

            async def leave() -> None:
                await self.show(one)

            with ui.element("div").classes("row").style("margin-top:.6rem"):
                button(say(f"alarms.confirm.{deed}"), go)
                button(say("object.no"), leave, look="plain")

    async def _send(self, deed: str, alarms: list[str], body: dict[str, Any]) -> None:
        client = self._mirror.client
        for alarm in alarms:
            if await attempt(partial(client.post, f"/v1/alarms/{alarm}/{deed}", body)) is None:
                break
        await self._mirror.ask_now("alarms")
