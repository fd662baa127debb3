"""What is missing before the first mission, each with the one next step and, where there is one, a button for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from service.access.keys import Role
from service.console.mirror import Mirror
from service.console.page_frame import Place, attempt, live, page_frame, picks
from service.console.teach_page import PATH as TEACH
from service.console.texts import say
from service.console.values import attribute


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One thing that a mission needs.

    Attributes:
        what: the thing, as a sentence that is true when all is well.
        fix: the next step; empty if nothing is missing.
        label, path, body: a button that takes the step: its label, where it posts to, and with what; a `path` that
            begins with `page:` is opened instead.
        again: label of the button while nothing is missing, for a step that may be taken again; empty for the others.
    """

    what: str
    fix: str = ""
    label: str = ""
    path: str = ""
    body: Any = None
    again: str = ""


def install(place: Place) -> None:
    """Add the page at `/setup`."""

    @ui.page("/setup", title=f"{say('nav.setup')} · {say('title')}")
    def setup_page() -> None:
        mirror = place.mirror

        async def take(number: str) -> None:
            check = list(checks(mirror))[int(number)]
            if check.path.startswith("page:"):
                ui.navigate.to(check.path.removeprefix("page:"))
                return
            await attempt(lambda: mirror.client.post(check.path, check.body))
            mirror.hurry()

        with page_frame(place, "setup"), ui.element("section").classes("card"):
            ui.html(say("setup.heading"), sanitize=False, tag="h2")
            listed = ui.html("", sanitize=False)
            live(
                picks(listed, take, what="step"),
                lambda: _listed(list(checks(mirror)), may_take=mirror.may(Role.OPERATOR)),
            )


def _listed(found: list[Check], *, may_take: bool) -> str:
    missing = [check for check in found if check.fix]
    line = say("setup.next", step=missing[0].fix) if missing else say("setup.ready")
    parts = [f'<p role="status"><b>{attribute(line)}</b></p><table class="list checks"><tbody>']
    for k, check in enumerate(found):
        state = f'<span class="chip {"warn" if check.fix else "good"}">{say("setup.missing" if check.fix else "setup.ok")}</span>'
        step = ""
        if check.fix and check.path and (may_take or check.path.startswith("page:")):
            is_next = check is missing[0]
            step = f'<button type="button" class="{"do" if is_next else "plain"}" data-step="{k}">{attribute(check.label)}</button>'
        elif check.again and may_take:
            step = f'<button type="button" class="plain" data-step="{k}">{attribute(check.again)}</button>'
        fix = f'<br><span class="quiet">{attribute(check.fix)}</span>' if check.fix else ""
        parts.append(f"<tr><td>{state}</td><td>{attribute(check.what)}{fix}</td><td>{step}</td></tr>")
    return "".join([*parts, "</tbody></table>"])


def checks(mirror: Mirror) -> Iterator[Check]:
    """Yield what a mission needs, in the order in which it is to be put right."""
    ready = mirror.said("ready")
    yield Check(
        what=say("setup.service"), fix="" if ready is not None and ready["is_running"] else say("setup.service.fix")
    )
    missing = [] if ready is None else ready["missing"]
    for one in missing:
        device = one["device"]
        yield Check(
            what=say("setup.devices"),
            fix=say("setup.devices.fix", device=device, hint=one["hint"]),
            label=say("setup.devices.do", device=device),
            path=f"/v1/devices/{device}/connect",
        )
    if not missing:
        yield Check(what=say("setup.devices"))
    yield from _records(mirror)
    stop = mirror.said("stop")
    is_latched = stop is not None and stop["is_latched"]
    yield Check(what=say("setup.stop"), fix=say("setup.stop.fix") if is_latched else "")
    lease = mirror.said("lease")
    held = lease is not None and lease["is_held"]
    yield Check(what=say("setup.lease"), fix=say("setup.lease.fix", holder=lease["holder"]) if held else "")
    is_located = any(frame["child"] == "panel" for frame in mirror.said("frames", {"frames": []})["frames"])
    yield Check(
        what=say("setup.locate"),
        fix="" if is_located else say("setup.locate.fix"),
        label=say("setup.locate.do"),
        again=say("setup.locate.again"),
        path="/v1/panel-pose",
        body={},
    )
    has_run = bool(mirror.said("missions", {"missions": []})["missions"])
    yield Check(
        what=say("setup.mission"),
        fix="" if has_run else say("setup.mission.fix"),
        label=say("setup.mission.do"),
        path="page:/missions",
    )


def _records(mirror: Mirror) -> Iterator[Check]:
    """Yield what the files of the cell lack."""
    panel = mirror.panel
    guessed = () if panel is None else panel.to_measure
    yield Check(what=say("setup.panel"), fix=say("setup.panel.fix", keys=", ".join(guessed)) if guessed else "")
    lacks_objects = panel is not None and not panel.objects
    yield Check(
        what=say("setup.objects"),
        fix=say("setup.objects.fix") if lacks_objects else "",
        label=say("setup.objects.do"),
        again=say("setup.objects.again"),
        path=f"page:{TEACH}",
    )
    records = mirror.said("calibrations", {"calibrations": []})["calibrations"]
    bare = [one["device"] for one in records if one["mount"] is None]
    fix = say("setup.calibrations.fix", device=bare[0]) if bare else ""
    yield Check(what=say("setup.calibrations"), fix=fix)
