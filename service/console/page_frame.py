"""What all pages share: the head with the stop, the way to the other pages, what is wrong now, and parts of HTML."""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from hal.errors import CellError
from service.access.keys import Role
from service.console.mirror import Mirror, Person
from service.console.texts import say, word
from service.console.values import STALE_S, attribute

PATHS = {
    "panel": "/",
    "missions": "/missions",
    "rounds": "/rounds",
    "alarms": "/alarms",
    "review": "/review",
    "history": "/history",
    "devices": "/devices",
    "setup": "/setup",
    "cell": "/cell",
}
CALLING = ("unacknowledged", "returned-unacknowledged")  # states of alarms that call for a person
REFRESH_S = 0.25
LOOK_S = 0.05  # so soon does a page show what the service said
AT_LEAST_S = 2.0  # so often it is put together again, because time passes
# A click or the Enter key on something that carries the name of an object.
PICK = (
    "(event) => { if (event.type === 'keydown' && !['Enter', ' '].includes(event.key)) return;"
    " const one = event.target.closest('[data-%s]'); if (!one) return; event.preventDefault(); emit(one.dataset.%s); }"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """What the pages need: the console's own port and the stop port, and the mirror of whoever asks for the page."""

    port: int
    stop_port: int

    @property
    def mirror(self) -> Mirror:
        """The mirror of the person whose page is being built."""
        mirror: Mirror = ui.context.client.request.state.mirror
        return mirror


@contextmanager
def page_frame(place: Place, current: str) -> Iterator[None]:
    """Lay out one page: what is built inside becomes its main part."""
    mirror = place.mirror
    ui.add_head_html('<link rel="stylesheet" href="/web/console.css">')
    ui.add_body_html(stop_box(place, may_reset=mirror.may(Role.OPERATOR)))
    with ui.element("div").classes("top"):
        heading = ui.html("", sanitize=False)
        ways = ui.html("", sanitize=False, tag="nav").props(f'aria-label="{say("nav")}"')
    with ui.element("div").classes("main"):  # NiceGUI lays it out inside of its own <main>
        banner = ui.html("", sanitize=False).classes("banner").props("role=alert")
        yield
    live(ways, lambda: _ways(mirror, current), of=mirror)
    live(heading, lambda: _heading(mirror), of=mirror)
    live(banner, lambda: trouble(mirror), of=mirror)


def stop_box(place: Place, *, may_reset: bool) -> str:
    """Return the stop's own HTML and script, which need nothing of the console once they are loaded."""
    words = {key: say(f"stop.{key}") for key in ("stopping", "stopped", "clear", "silent")}
    return (
        f'<aside id="stop-box" aria-label="{say("stop.label")}" data-latched="unknown" data-own-port="{place.port}" '
        f'data-stop-port="{place.stop_port}" data-utc="{time.time():.2f}" data-stale-s="{STALE_S:.0f}" '
        f'data-words="{attribute(json.dumps(words))}">'
        f'<p id="stop-line" role="status">{say("stop.unknown")}</p>'
        f'<button id="stop-reset" type="button" data-may="{"yes" if may_reset else "no"}" hidden>{say("stop.reset")}</button>'
        f'<button id="stop-button" type="button" title="{attribute(say("stop.title"))}">{say("stop.label")}</button></aside>'
        '<script src="/web/stop.js"></script><script src="/web/page.js"></script>'
    )


def live(element: Any, render: Callable[[], str], *, every_s: float = REFRESH_S, of: Mirror | None = None) -> None:
    """Show what `render` returns and keep it up to date; nothing is sent while it stays the same.

    Args:
        of: the mirror, if `render` depends on nothing else: then it is called at once when the service has said something new,
            and seldom otherwise.
    """
    seen = (-1, 0.0)

    def renew() -> None:
        nonlocal seen
        if of is not None:
            if seen[0] == of.version and time.monotonic() - seen[1] < AT_LEAST_S:
                return
            seen = (of.version, time.monotonic())
        content = render()
        if content != element.content:
            element.set_content(content)

    renew()
    ui.timer(every_s if of is None else LOOK_S, renew)


def button(label: str, on_click: Callable[[], Any], *, look: str = "do") -> Any:
    """Return a plain button."""
    return (
        ui.html(attribute(label), sanitize=False, tag="button")
        .classes(look)
        .props("type=button")
        .on("click", lambda _: on_click())
    )


def open_dialog(dialog: Any, name: str) -> None:
    """Open a dialog under the name that screen readers tell."""
    dialog.props["aria-label"] = name
    dialog.open()


def picks(element: Any, on_pick: Callable[[str], Any], *, what: str = "object") -> Any:
    """Call `on_pick` with the name that a clicked part of the element carries in its `data-` attribute."""
    for kind in ("click", "keydown"):
        element.on(kind, lambda event: on_pick(str(event.args)), js_handler=PICK % (what, what))
    return element


async def attempt(deed: Callable[[], Awaitable[Any]]) -> Any:
    """Do something with the service; a refusal is shown as a sentence with what to do. Returns None then."""
    try:
        return await deed()
    except CellError as error:
        ui.notify(f"{error.what}. {say('try', hint=error.hint)}", type="negative", multi_line=True, timeout=12_000)
        return None


def trouble(mirror: Mirror) -> str:
    """Return what keeps the cell from working, as HTML; empty if nothing does."""
    if mirror.must_log_in:
        return f'{attribute(say("session.ended"))} <a href="/login.html">{attribute(say("session.log_in"))}</a>'
    if mirror.problem is not None:
        return attribute(f"{mirror.problem.what}: {mirror.problem.hint}")
    ready, lines = mirror.said("ready"), []
    if ready is not None and not ready["is_running"]:
        detail = next((one["detail"] for one in ready["processes"] if one["detail"]), say("starting"))
        lines.append(say("not_running", detail=detail))
    for one in (ready or {"missing": []})["missing"]:
        lost = ", ".join(word("verb", verb) for verb in one["lost"]) or say("only_readings")
        lines.append(say("without", device=one["device"], why=one["why"], lost=lost))
    lease = mirror.said("lease")
    if lease is not None and lease["is_held"]:
        lines.append(say("lease.held", holder=lease["holder"]))
    return "<br>".join(attribute(line) for line in lines)


def table(columns: list[str], rows: list[str], *, name: str, empty: str = "") -> str:
    """Return an HTML table called `name`; `columns` are keys of texts, `rows` are HTML."""
    if not rows:
        return f'<p class="quiet">{attribute(empty)}</p>'
    head = "".join(_head(column) for column in columns)
    body = f'<table class="list"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return f'<div class="scroll" tabindex="0" role="group" aria-label="{attribute(name)}">{body}</div>'


def _head(column: str) -> str:
    """Return the head of a column; one of buttons has none."""
    told = say(f"column.{column}")
    return f'<th scope="col">{attribute(told)}</th>' if told else "<td></td>"


def clock(seconds: float | None) -> str:
    """Return a moment for people, in the time of the cell's machine."""
    if seconds is None:
        return "–"
    moment = time.localtime(seconds)
    is_today = moment[:3] == time.localtime()[:3]
    return time.strftime("%H:%M:%S" if is_today else "%Y-%m-%d %H:%M", moment)


def _ways(mirror: Mirror, current: str) -> str:
    """Return the links to all pages, with the number of alarms that nobody has acknowledged."""
    alarms = mirror.said("alarms", {"alarms": []})["alarms"]
    calling = sum(one["state"] in CALLING for one in alarms)
    mark = f' <b class="count" title="{say("nav.calling")}">{calling}</b>' if calling else ""
    return "".join(
        f'<a href="{path}"{" aria-current=page" if name == current else ""}>{say(f"nav.{name}")}'
        f"{mark if name == 'alarms' else ''}</a>"
        for name, path in PATHS.items()
    )


def _heading(mirror: Mirror) -> str:
    info = mirror.said("info")
    line = say("cell.unknown")
    if info is not None:
        line = say("cell", cell=info["cell"], mode=word("mode", info["mode"]), panel=info["panel"])
    return f'<h1>panelwright</h1><span class="quiet">{attribute(line)}</span>{_person(mirror.person)}'


def _person(person: Person) -> str:
    """Return who is logged in, with the way out; empty while the service has no keys."""
    if person.name is None:
        return ""
    told = attribute(say("person", name=person.name, role=word("role", person.role)))
    return f'<p class="quiet" id="person">{told} <button type="button" class="plain" id="log-out">{say("log_out")}</button></p>'
