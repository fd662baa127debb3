"""The panel as drawn from its file beside the live picture, with every value; a click opens the object."""

from __future__ import annotations

from typing import Any

from nicegui import ui
from scipy.spatial.transform import RigidTransform

from hal.panel import PanelObject
from service.console.mirror import Mirror
from service.console.mission_words import is_plan, name_of
from service.console.object_dialog import ObjectDialog
from service.console.object_facts import alarm_line
from service.console.page_frame import Place, clock, live, page_frame, picks, table
from service.console.panel_drawing import overlay_svg, panel_svg
from service.console.poses import camera_from_panel, has_moved, lens_of
from service.console.texts import say, word
from service.console.values import Reading, age, attribute, confidence, label_of, shown, sigma


def install(place: Place) -> None:
    """Add the page at `/`."""

    @ui.page("/", title=f"{say('nav.panel')} · {say('title')}")
    def panel_page() -> None:
        mirror = place.mirror
        with page_frame(place, "panel"):
            dialog = ObjectDialog(mirror)
            with ui.element("section").classes("card most"):
                live(ui.html("", sanitize=False, tag="h2"), lambda: _title(mirror), of=mirror)
                drawing = ui.html("", sanitize=False).classes("panel-drawing")
                live(picks(drawing, dialog.show), lambda: _drawing(mirror), of=mirror)
                ui.html(say("panel.pick"), sanitize=False, tag="p").classes("quiet")
            with ui.element("div").classes("third"):
                _live_picture(mirror, dialog)
                with ui.element("section").classes("card").style("margin-top:1rem"):
                    live(ui.html("", sanitize=False).classes("told"), lambda: last_mission(mirror), of=mirror)
            with ui.element("section").classes("card"):
                ui.html(say("panel.values"), sanitize=False, tag="h2")
                values = ui.html("", sanitize=False).classes("values")
                live(picks(values, dialog.show), lambda: _values(mirror), of=mirror)


def _title(mirror: Mirror) -> str:
    panel = mirror.panel
    return attribute(say("panel.waiting") if panel is None else say("panel.heading", name=panel.name))


def _drawing(mirror: Mirror) -> str:
    panel = mirror.panel
    return "" if panel is None else panel_svg(panel, mirror.readings(), mirror.alarms())


def _values(mirror: Mirror) -> str:
    panel, readings, alarms = mirror.panel, mirror.readings(), mirror.alarms()
    if panel is None:
        return ""
    rows = [_row(one, readings.get(one.name), alarms.get(one.name)) for one in panel.objects]
    return table(["object", "value", "age", "confidence", "alarm"], rows, name=say("panel.values"))


def _row(one: PanelObject, reading: Reading | None, alarm: dict[str, Any] | None) -> str:
    value = shown(one, reading)
    why = reading["cause"] if reading is not None and reading["quality"] != "valid" else sigma(one, reading)
    row = f' data-row="{reading["utc_s"]:.1f}"' if reading is not None else ""
    says = ""
    if alarm is not None:
        look, told = alarm_line(alarm)
        says = f'<span class="{look}">{attribute(told)}</span>'
    return (
        f'<tr{row}><td><button type="button" class="name" data-object="{one.name}">{attribute(label_of(one))}</button></td>'
        f'<td><b>{attribute(value)}</b> <span class="quiet">{attribute(why)}</span></td>'
        f"<td>{age(reading)}</td><td>{confidence(reading)}</td><td>{says}</td></tr>"
    )


def last_mission(mirror: Mirror) -> str:
    """Return when the last mission ran and how it ended, with its report."""
    heading = f"<h2>{say('last.heading')}</h2>"
    task = next((one for one in mirror.tasks if one["verb"] == "missions" and not is_plan(one)), None)
    if task is None:
        return heading + f'<p class="quiet">{say("last.none")}</p>'
    line = say("last.ended", started=clock(task["created_s"]), verdict=word("state", task["state"]))
    result, problem = task["result"] or {}, task["problem"]
    link = result.get("report")
    parts = [heading, f"<p>{attribute(line)}</p>"]
    if problem is not None:
        parts.append(
            f'<p class="bad">{attribute(problem["detail"])}</p><p class="quiet">{attribute(problem["hint"])}</p>'
        )
    for action in result.get("actions", []):
        look = "good" if action["confirmed"] else "bad"
        label = name_of(mirror.panel, action["object"])
        told = say("last.action", label=label, before=action["before"], after=action["after"] or "–")
        parts.append(f'<p class="{look}">{attribute(told)}</p>')
    if link:
        parts.append(
            f'<p><a href="/relay{attribute(link)}" target="_blank" rel="noopener">{say("last.report")}</a></p>'
        )
    return "".join(parts)


def _live_picture(mirror: Mirror, dialog: ObjectDialog) -> None:
    with ui.element("section").classes("card"):
        ui.html(say("live.heading"), sanitize=False, tag="h2")
        holder = ui.element("div").classes("live")
        with holder:
            live(ui.html("", sanitize=False), lambda: _picture(mirror), of=mirror)
            overlay = ui.html("", sanitize=False).classes("overlay")
        ui.html('<p class="quiet" id="picture-line"></p>', sanitize=False)
        note = ui.html("", sanitize=False, tag="p").classes("quiet")
        outlines = _Outlines(mirror)
        live(picks(overlay, dialog.show), outlines.drawn, every_s=0.5)
        live(note, lambda: say(outlines.says))


def _camera(mirror: Mirror) -> str | None:
    devices = mirror.said("devices", {"devices": []})["devices"]
    return next((one["name"] for one in devices if one["kind"] == "camera"), None)


def _picture(mirror: Mirror) -> str:
    camera = _camera(mirror)
    if camera is None:
        return ""
    name = attribute(camera.replace("_", " "))
    return (
        f'<img data-source="/relay/v1/devices/{camera}/reading" data-name="{name}" data-line="picture-line" '
        f'alt="{attribute(say("live.alt", camera=name))}">'
    )


class _Outlines:
    """The outlines over the live picture, while the arm rests; `says` is the key of what to tell about them."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._seen: RigidTransform | None = None
        self._frames: Any = None
        self._rests = False
        self.says = "live.not_located"

    def drawn(self) -> str:
        """Return the outlines as SVG; empty when there are none."""
        mirror, camera = self._mirror, _camera(self._mirror)
        panel, frames = mirror.panel, mirror.said("frames")
        if camera is None or panel is None:
            self.says = "live.none" if panel is not None else "panel.waiting"
            return ""
        pose, lens = camera_from_panel(mirror, camera), lens_of(mirror, camera)
        if frames is not self._frames:  # a new answer: the arm rests when it agrees with the one before
            self._rests = not has_moved(self._seen, pose)
            self._seen, self._frames = pose, frames
        if pose is None or lens is None:
            self.says = "live.not_located"
            return ""
        self.says = "live.overlay" if self._rests else "live.moving"
        return overlay_svg(panel, pose, lens, mirror.readings()) if self._rests else ""
