"""Puts another driver or other options in the place of a device's, while the cell runs."""

from __future__ import annotations

import tomllib

from nicegui import ui

from hal.errors import CellError
from hal.toml_text import toml_text
from service.console.mirror import Mirror
from service.console.page_frame import attempt, button, open_dialog
from service.console.texts import say
from service.console.values import attribute

SECRET = "***"  # what the service shows in place of a secret  # noqa: S105 - none itself


class DeviceDialog:
    """The dialog of one page; `show` opens it for a device."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._dialog = ui.dialog().props("no-esc-dismiss")  # the Esc key is the stop
        with self._dialog, ui.card().classes("dialog"):
            self._form = ui.element("div")
            self._told = ui.html("", sanitize=False, tag="p").classes("bad").props("role=status")

    async def show(self, name: str) -> None:
        """Open the dialog with the present driver and options of a device."""
        client = self._mirror.client
        found = await attempt(lambda: client.get(f"/v1/devices/{name}"))
        if found is None:
            return
        options = {key: value for key, value in found["options"].items() if value != SECRET}
        hidden = sorted(set(found["options"]) - set(options))
        heading = say("device.swap.heading", name=name)
        self._told.set_content("")
        self._form.clear()
        with self._form:
            ui.html(attribute(heading), sanitize=False, tag="h2")
            says = [say("device.swap.says"), *([say("device.swap.secret", keys=", ".join(hidden))] if hidden else [])]
            ui.html(attribute(" ".join(says)), sanitize=False, tag="p").classes("quiet")
            driver = ui.input(label=say("device.swap.driver"), value=found["driver"]).props("outlined dense")
            text = ui.textarea(label=say("device.swap.options"), value=toml_text(options) if options else "")
            text.props("outlined autogrow input-class=code").classes("file")

            async def swap() -> None:
                try:
                    body = {"driver": str(driver.value or "").strip(), "options": tomllib.loads(str(text.value or ""))}
                except tomllib.TOMLDecodeError as error:
                    self._told.set_content(attribute(say("device.swap.no_toml", why=error)))
                    return
                self._told.set_content(attribute(say("device.swap.connecting")))
                try:
                    await client.fetch("PUT", f"/v1/devices/{name}", body)
                except CellError as error:
                    told = say("device.swap.kept", what=error.what, hint=error.hint)
                    self._told.set_content(attribute(told))
                else:
                    ui.notify(say("device.connected", name=name), type="positive")
                    self._dialog.close()
                self._mirror.hurry()

            with ui.element("div").classes("row").style("margin-top:.6rem"):
                button(say("device.swap.do"), swap)
                button(say("object.no"), self._dialog.close, look="plain")
        open_dialog(self._dialog, heading)
