"""Runs and follows missions, cancels them, and lists reports and tasks."""

from __future__ import annotations

import time
from typing import Any

from nicegui import ui

from service.client import FINAL
from service.console.mirror import Mirror
from service.console.page_frame import Place, attempt, button, clock, live, page_frame, table
from service.console.texts import say, word
from service.console.values import attribute

LOOKS = {"succeeded": "good", "failed": "bad", "cancelled": "warn", "cancelling": "warn"}


def install(place: Place) -> None:
    """Add the page at `/missions`."""

    @ui.page("/missions", title=f"{say('nav.missions')} · {say('title')}")
    def missions_page() -> None:
        mirror = place.mirror

        async def run() -> None:
            await attempt(lambda: mirror.client.post("/v1/missions", {}))
            mirror.hurry()

        async def cancel() -> None:
            active = mirror.active
            if active is not None:
                await attempt(lambda: mirror.client.post(f"/v1/tasks/{active['id']}/cancel"))
                mirror.hurry()

        with page_frame(place, "missions"):
            with ui.element("section").classes("card half"):
                ui.html(say("missions.heading"), sanitize=False, tag="h2")
                ui.html(say("missions.says"), sanitize=False, tag="p").classes("quiet")
                with ui.element("div").classes("row"):
                    start = button(say("missions.run"), run)
                    end = button(say("missions.cancel"), cancel, look="plain")
                live(ui.html("", sanitize=False).props("role=status"), lambda: _progress(mirror))
                ui.html(say("missions.steps"), sanitize=False, tag="h2").style("margin-top:1rem")
                live(ui.html("", sanitize=False), lambda: steps(mirror))

                def enable() -> None:
                    is_busy = mirror.active is not None
                    for one, is_off in ((start, is_busy), (end, not is_busy)):
                        if is_off is not bool(one.props.get("disabled")):
                            one.props("disabled") if is_off else one.props(remove="disabled")

                enable()
                ui.timer(0.25, enable)
            with ui.element("section").classes("card half"):
                ui.html(say("missions.reports"), sanitize=False, tag="h2")
                live(ui.html("", sanitize=False), lambda: _reports(mirror))
            with ui.element("section").classes("card"):
                ui.html(say("missions.tasks"), sanitize=False, tag="h2")
                live(ui.html("", sanitize=False), lambda: _tasks(mirror))


def _progress(mirror: Mirror) -> str:
    task = mirror.active
    if task is None:
        return f'<p class="quiet">{say("missions.idle")}</p>'
    percent = round(100 * task["fraction"])
    line = say("missions.running", verb=word("verb", task["verb"]), percent=percent)
    return f'<p>{attribute(line)}</p><div class="bar"><i style="width:{percent}%"></i></div>'


def steps(mirror: Mirror) -> str:
    """Return the steps of the task that runs, or of the last one, with what went wrong and what to do."""
    task = mirror.active or next(iter(mirror.tasks), None)
    if task is None:
        return f'<p class="quiet">{say("missions.no_tasks")}</p>'
    lines, last = [], ""
    for event in mirror.events.get(task["id"], []):
        told = " · ".join(part for part in (event["step"], event["detail"]) if part)
        if event["kind"] == "progress" and told != last:
            lines.append(f"<li><time>{clock(event['time_s'])}</time><span>{attribute(told)}</span></li>")
            last = told
    if task["state"] in FINAL:
        lines.append(f'<li><span class="{LOOKS.get(task["state"], "")}">{word("state", task["state"])}</span></li>')
    problem = task["problem"]
    if problem is not None:
        lines.append(
            f'<li class="bad">{attribute(problem["detail"])}</li><li>{attribute(say("try", hint=problem["hint"]))}</li>'
        )
    return f'<ol class="steps" tabindex="0" aria-label="{say("missions.steps")}">{"".join(lines)}</ol>'


def _reports(mirror: Mirror) -> str:
    rows = []
    for mission in mirror.said("missions", {"missions": []})["missions"]:
        link = mission["report_url"]
        shown = (
            f'<a href="/relay{attribute(link)}" target="_blank" rel="noopener">{say("last.report")}</a>'
            if link
            else "–"
        )
        started = (mission["started"] or "–").replace("T", " ").replace("Z", " UTC")
        rows.append(f"<tr><td>{attribute(started)}</td><td>{attribute(mission['name'])}</td><td>{shown}</td></tr>")
    return table(
        ["started", "mission", "report"], rows[:50], name=say("missions.reports"), empty=say("missions.no_reports")
    )


def _tasks(mirror: Mirror) -> str:
    return table(
        ["started", "task", "state", "step", "took"],
        [_task_row(task) for task in mirror.tasks[:15]],
        name=say("missions.tasks"),
        empty=say("missions.no_tasks"),
    )


def _task_row(task: dict[str, Any]) -> str:
    problem = task["problem"]
    step = problem["detail"] if problem is not None else task["step"]
    took = "–"
    if task["started_s"] is not None:
        took = f"{(task['ended_s'] or time.time()) - task['started_s']:.0f} s"
    state = f'<span class="chip {LOOKS.get(task["state"], "")}">{word("state", task["state"])}</span>'
    return (
        f"<tr><td>{clock(task['created_s'])}</td><td>{attribute(word('verb', task['verb']))}</td><td>{state}</td>"
        f"<td>{attribute(step or '–')}</td><td>{took}</td></tr>"
    )
