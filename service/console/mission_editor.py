"""The editor of missions: the file and a form of it side by side, checked by the service while somebody types."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from nicegui import ui

from service.access.keys import Role
from service.console.mirror import Mirror
from service.console.mission_form import MissionForm
from service.console.mission_words import step_list
from service.console.page_frame import Place, attempt, button, page_frame
from service.console.texts import say
from service.console.values import attribute

PATH = "/mission-editor"
LOOK_S = 0.3  # so long after the last key, at most, the text is sent to be checked
BLANK = 'schema = 1\ntitle = ""\n\n[[steps]]\nkind = "inspect"\nname = "read"\n'


def install(place: Place) -> None:
    """Add the page at `/mission-editor`; `?mission=demo` opens that mission, without it a new one is begun."""

    @ui.page(PATH, title=f"{say('editor.title')} · {say('title')}")
    def editor_page(mission: str = "") -> None:
        with page_frame(place, "missions"):
            _Editor(place.mirror, mission)


class _Editor:
    """What one browser edits.

    The text is what is stored; the form is another view of it.
    """

    def __init__(self, mirror: Mirror, name: str) -> None:
        self._mirror = mirror
        self._loaded = name
        self._digest: str | None = None
        self._checked: tuple[str, str] | None = None  # the name and text that the service has judged
        self._is_good = False
        with ui.element("section").classes("card half"):
            ui.html(say("editor.form"), sanitize=False, tag="h2")
            self._form = MissionForm(mirror, self._take_form)
        with ui.element("section").classes("card half"):
            ui.html(say("editor.text"), sanitize=False, tag="h2")
            self._said = ui.html("", sanitize=False, tag="p").classes("quiet")
            with ui.element("div").classes("row search"):
                self._name = ui.input(label=say("editor.file"), value=name).props("outlined dense maxlength=61")
                self._save = button(say("editor.save"), self._store)
                ui.html(f'<a href="/missions">{say("editor.back")}</a>', sanitize=False)
            self._text = (
                ui.textarea(label=say("editor.text.label"), on_change=self._take_text)
                .props("outlined autogrow spellcheck=false input-class=code debounce=100")
                .classes("file")
            )
            self._verdict = ui.html("", sanitize=False).props("role=status")
        ui.timer(0.05, self._open, once=True)
        ui.timer(LOOK_S, self._check)

    async def _open(self) -> None:
        if not self._loaded:
            self._show(BLANK)
            return
        found = await attempt(lambda: self._mirror.client.get(_file(self._loaded)))
        if found is not None:
            self._digest = found["digest"]
            self._said.set_content(say("editor.shipped") if found["is_shipped"] else "")
            self._show(found["text"])

    def _show(self, text: str) -> None:
        self._text.set_value(text)
        self._form.show(text)

    def _take_form(self, text: str) -> None:
        self._text.set_value(text)

    def _take_text(self) -> None:
        self._form.show(self._written)

    @property
    def _written(self) -> str:
        return str(self._text.value or "")

    @property
    def _named(self) -> str:
        return str(self._name.value or "").strip()

    async def _check(self) -> None:
        """Let the service check the text, unless it has judged it already."""
        asked = (self._named, self._written)
        if asked != self._checked:
            self._checked, self._is_good = asked, False
            draft = {"text": asked[1], **({"name": asked[0]} if asked[0] else {})}
            self._verdict.set_content(f'<p class="quiet">{say("editor.checking")}</p>')
            found = await attempt(lambda: self._mirror.client.post("/v1/mission-files/check", draft))
            if found is None:
                self._verdict.set_content("")
            elif asked == self._checked:
                self._is_good = found["problem"] is None
                self._verdict.set_content(self._told(found))
        can_save = self._is_good and bool(self._named) and self._mirror.may(Role.MAINTAINER)
        if can_save is bool(self._save.props.get("disabled")):
            self._save.props(remove="disabled") if can_save else self._save.props("disabled")

    def _told(self, found: dict[str, Any]) -> str:
        if found["problem"] is None:
            return f'<p class="good">{say("editor.good")}</p>{step_list(found["steps"], self._mirror.panel)}'
        faults = "".join(f"<li>{attribute(one)}</li>" for one in found["faults"])
        return f'<p class="bad">{say("editor.faults")}</p><ul class="faults">{faults}</ul>'

    async def _store(self) -> None:
        name, text = self._named, self._written
        body = {"text": text, "replaces": self._digest if name == self._loaded else None}
        if await attempt(lambda: self._mirror.client.fetch("PUT", _file(name), body)) is None:
            return
        found = await attempt(lambda: self._mirror.client.get(_file(name)))
        if found is not None:
            self._loaded, self._digest = name, found["digest"]
        self._said.set_content("")
        ui.notify(say("editor.saved", name=name), type="positive")
        await self._mirror.ask_now("mission_files")


def _file(name: str) -> str:
    return f"/v1/mission-files/{quote(name, safe='')}"
