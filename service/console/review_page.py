"""Readings that wait for a person: one picture, one question, one key for each answer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from nicegui import ui

from hal.panel import PanelObject
from service.access.keys import Role
from service.console.alarms_page import you_field
from service.console.mirror import Mirror
from service.console.page_frame import Place, attempt, button, clock, live, page_frame, picks
from service.console.texts import say
from service.console.values import attribute, label_of, shown, unit_of

UNREADABLE, LATER = "u", "l"
MOST_NUMBERED = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """One answer: the key that gives it, its words, and what is sent to the service; an empty body asks again later."""

    key: str
    told: str
    body: dict[str, Any] = field(default_factory=dict)


def install(place: Place) -> None:
    """Add the page at `/review`."""

    @ui.page("/review", title=f"{say('nav.review')} · {say('title')}")
    def review_page() -> None:
        mirror = place.mirror
        with page_frame(place, "review"), ui.element("section").classes("card"):
            ui.html(say("review.heading"), sanitize=False, tag="h2")
            _Desk(mirror)


class _Desk:
    """The queue of one browser. What was answered here is gone at once; the service says what waits."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._over: set[int] = set()
        self._answered = 0
        self._is_sending = False
        live(ui.html("", sanitize=False, tag="p").props("role=status"), self._line)
        live(ui.html("", sanitize=False), self._question)
        if not mirror.may(Role.OPERATOR):
            ui.html(say("review.look_only"), sanitize=False, tag="p").classes("quiet")
            return
        answers = picks(ui.html("", sanitize=False).classes("row answers"), self.answer, what="answer")
        live(answers.props(f'role=group aria-label="{say("review.answers")}"'), self._answers)
        with ui.element("div").classes("row").style("margin:.8rem 0"):
            self._other = ui.input(label=say("review.other")).props("outlined dense maxlength=100")
            self._other.on("keydown.enter", self._send_other)
            button(say("review.send"), self._send_other, look="plain")
            self._you = you_field(mirror).style("min-width:16rem")
            self._teaches = ui.switch(say("review.teach"))
            self._teaches.set_visibility(mirror.may(Role.MAINTAINER))
        ui.html(say("review.says"), sanitize=False, tag="p").classes("quiet")
        ui.keyboard(self._key, repeating=False, ignore=["input", "select", "textarea"])

    @property
    def _waiting(self) -> list[dict[str, Any]]:
        found = self._mirror.said("review", {"readings": []})["readings"]
        return [item for item in found if item["reading"]["id"] not in self._over]

    @property
    def _item(self) -> dict[str, Any] | None:
        waiting = self._waiting
        return waiting[0] if waiting else None

    async def answer(self, key: str) -> None:
        """Give the answer that a key stands for."""
        item = self._item
        chosen = next((one for one in self._choices() if one.key == key), None)
        if item is None or chosen is None:
            return
        if chosen.body:
            await self._send(item, chosen.body)
        else:
            self._over.add(item["reading"]["id"])

    async def _key(self, event: Any) -> None:
        if event.action.keydown and not any((event.modifiers.ctrl, event.modifiers.alt, event.modifiers.meta)):
            await self.answer(str(event.key).lower())

    async def _send_other(self) -> None:
        item, given = self._item, str(self._other.value or "").strip()
        if item is None or not given:
            return
        await self._send(item, {"verdict": "wrong", **_shows(given, self._object(item))})

    async def _send(self, item: dict[str, Any], body: dict[str, Any]) -> None:
        who = str(self._you.value or "").strip()
        if not who:
            ui.notify(say("alarms.you.missing"), type="warning")
            return
        if self._is_sending:
            return
        self._is_sending = True
        number = item["reading"]["id"]
        given = {"by": who, "reason": say("review.reason"), **body}
        try:
            is_stored = await attempt(lambda: self._mirror.client.post(f"/v1/review/{number}", given)) is not None
            if is_stored:
                self._answered += 1
                self._over.add(number)
                self._other.set_value("")
            else:
                await self._mirror.ask_now("review")  # somebody else may have answered it
        finally:
            self._is_sending = False
        if is_stored and self._teaches.value and body["verdict"] != "unreadable":
            await self._teach(number)

    async def _teach(self, number: int) -> None:
        """Give an answered reading to the teaching of looks, and say what came of it."""
        taught = await attempt(lambda: self._mirror.client.post(f"/v1/review/{number}/teach", {}))
        if taught is not None:
            ui.notify(say("review.taught" if taught["added"] else "review.known", kind=taught["name"]), type="positive")

    def _object(self, item: dict[str, Any]) -> PanelObject | None:
        panel, name = self._mirror.panel, item["reading"]["object"]
        return next((one for one in panel.objects if one.name == name), None) if panel is not None else None

    def _choices(self) -> list[Choice]:
        item = self._item
        return [] if item is None else list(choices(item, self._object(item)))

    def _line(self) -> str:
        said = self._mirror.said("review")
        if said is None:
            return attribute(say("review.loading"))
        return attribute(say("review.line", waiting=len(self._waiting), answered=self._answered))

    def _question(self) -> str:
        item = self._item
        if item is None:
            return f'<p class="quiet">{say("review.none")}</p>' if self._mirror.said("review") is not None else ""
        following = "".join(_picture(one, "") for one in self._waiting[1:3])
        return question(item, self._object(item)) + f'<div hidden aria-hidden="true">{following}</div>'

    def _answers(self) -> str:
        return "".join(
            f'<button type="button" class="plain" data-answer="{one.key}"><kbd>{one.key.upper()}</kbd> '
            f"{attribute(one.told)}</button>"
            for one in self._choices()
        )


def choices(item: dict[str, Any], panel_object: PanelObject | None) -> Iterator[Choice]:
    """Yield the answers to a reading: what it showed or held back, its rivals, the object's other states, and the rest."""
    numbered = list(_numbered(item, panel_object))[:MOST_NUMBERED]
    for key, (told, body) in enumerate(numbered, start=1):
        yield Choice(key=str(key), told=told, body=body)
    yield Choice(key=UNREADABLE, told=say("review.unreadable"), body={"verdict": "unreadable"})
    yield Choice(key=LATER, told=say("review.later"))


def _numbered(item: dict[str, Any], panel_object: PanelObject | None) -> Iterator[tuple[str, dict[str, Any]]]:
    guess = item["guess"]
    if guess is not None:
        yield _told(item, panel_object, guess), {"verdict": "right"}
    for rival in item["rivals"]:
        if guess is None or rival["value"] != guess["value"]:
            yield (
                f"{rival['text'].strip()} {_unit(item, panel_object)}".rstrip(),
                {"verdict": "wrong", "value": rival["value"]},
            )
    for state in () if panel_object is None else panel_object.states_shown:
        if guess is None or state != guess["state"]:
            yield state, {"verdict": "wrong", "state": state}


def question(item: dict[str, Any], panel_object: PanelObject | None) -> str:
    """Return the picture of a reading and what is asked about it, as HTML."""
    reading = item["reading"]
    label = reading["object"] if panel_object is None else label_of(panel_object)
    why = say("review.why", when=clock(reading["utc_s"]), why=item["why"])
    picture = _picture(item, say("object.crop", when=clock(reading["utc_s"]))) or f"<p>{say('history.no_picture')}</p>"
    return (
        f'<h3 class="asked">{attribute(say("review.question", label=label))}</h3>'
        f'<div class="asked-picture">{picture}</div><p class="quiet">{attribute(why)}</p>'
    )


def _picture(item: dict[str, Any], told: str) -> str:
    url = item["reading"]["crop_url"]
    return "" if url is None else f'<img src="/relay{attribute(url)}" alt="{attribute(told)}">'


def _told(item: dict[str, Any], panel_object: PanelObject | None, shows: dict[str, Any]) -> str:
    """Return what an object shows in its own terms."""
    if panel_object is not None:
        return shown(panel_object, {**item["reading"], **shows, "quality": "valid"})
    return str(next(one for one in shows.values() if one is not None))


def _unit(item: dict[str, Any], panel_object: PanelObject | None) -> str:
    return "" if panel_object is None else unit_of(panel_object, item["reading"])


def _shows(given: str, panel_object: PanelObject | None) -> dict[str, Any]:
    """Return what a person has typed as the service takes it: a state, a number (an angle in radians), or a text."""
    if panel_object is not None and panel_object.states_shown:
        return {"state": given}
    try:
        value = float(given.replace(",", "."))
    except ValueError:
        return {"text": given}
    return {"value": math.radians(value) if panel_object is not None and panel_object.value_is_angle else value}
