"""Chooses, plans, runs, follows, cancels and takes up missions; lists reports and tasks."""

from __future__ import annotations

import time
from datetime import datetime
from typing import Any

from nicegui import ui

from hal.panel import Panel
from service.access.keys import Role
from service.client import FINAL
from service.console.mirror import Mirror
from service.console.mission_words import did, is_plan, lasting, step_list
from service.console.page_frame import PATHS, Place, attempt, button, clock, live, page_frame, picks, table
from service.console.texts import say, word
from service.console.values import attribute

LOOKS = {"succeeded": "good", "failed": "bad", "cancelled": "warn", "cancelling": "warn", "unfinished": "warn"}
FIRST = "inspect"  # chosen at first: it touches nothing
PLAN_S = 30.0
REPORT_COLUMNS = ["started", "mission", "outcome", "report", "resume"]


def install(place: Place) -> None:
    """Add the page at `/missions`."""

    @ui.page("/missions", title=f"{say('nav.missions')} · {say('title')}")
    def missions_page() -> None:
        mirror = place.mirror
        desk = _Desk(mirror)
        with page_frame(place, "missions"):
            with ui.element("section").classes("card half"):
                ui.html(say("missions.heading"), sanitize=False, tag="h2")
                choices = picks(ui.html("", sanitize=False), desk.choose, what="mission")
                choices.props(f'role=group aria-label="{say("missions.choose")}"')
                live(choices, desk.choices)
                live(ui.html("", sanitize=False), desk.steps)
                starts = []
                if mirror.may(Role.OPERATOR):
                    with ui.element("div").classes("row").style("margin-top:.6rem"):
                        starts = [
                            button(say("missions.run"), desk.run),
                            button(say("missions.plan"), desk.plan, look="plain"),
                        ]
                if mirror.may(Role.MAINTAINER):
                    live(ui.html("", sanitize=False), desk.edit)
                ui.html(say("missions.says"), sanitize=False, tag="p").classes("quiet")
                live(ui.html("", sanitize=False).props("role=status"), desk.planned)
            with ui.element("section").classes("card half"):
                ui.html(say("missions.now"), sanitize=False, tag="h2")
                live(ui.html("", sanitize=False).props("role=status"), lambda: _progress(mirror), of=mirror)
                with ui.element("div").classes("row"):
                    end = button(say("missions.cancel"), desk.cancel, look="plain")
                    hold = button(say("missions.pause"), desk.pause, look="plain")
                live(ui.html("", sanitize=False), lambda: steps(mirror))
            with ui.element("section").classes("card"):
                ui.html(say("missions.reports"), sanitize=False, tag="h2")
                live(
                    picks(ui.html("", sanitize=False), desk.resume, what="resume"), lambda: _reports(mirror), of=mirror
                )
            with ui.element("section").classes("card"):
                ui.html(say("missions.tasks"), sanitize=False, tag="h2")
                live(ui.html("", sanitize=False), lambda: _tasks(mirror), of=mirror)

            def enable() -> None:
                active = mirror.active
                is_busy = active is not None
                can_pause = active is not None and active["can_pause"] and mirror.may(Role.OPERATOR)
                told = say("missions.pause" if active is None or active["pause"] == "no" else "missions.go_on")
                if told != hold.content:
                    hold.set_content(told)
                run = [(start, desk.can_run and not is_busy) for start in starts]
                for one, is_on in [*run, (end, is_busy), (hold, can_pause)]:
                    if is_on is bool(one.props.get("disabled")):
                        one.props(remove="disabled") if is_on else one.props("disabled")

            enable()
            ui.timer(0.25, enable)


class _Desk:
    """What one browser has chosen on the page, and the plan of its dry run."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._name = FIRST
        self._plan: tuple[str, dict[str, Any]] | None = None

    @property
    def _chosen(self) -> dict[str, Any] | None:
        files = self._files()
        return next((one for one in files if one["name"] == self._name), files[0] if files else None)

    @property
    def can_run(self) -> bool:
        """Whether the chosen mission fits the panel."""
        chosen = self._chosen
        return chosen is not None and chosen["problem"] is None

    def choose(self, name: str) -> None:
        """Choose a mission file."""
        self._name, self._plan = name, None

    async def run(self) -> None:
        """Run the chosen mission."""
        chosen = self._chosen
        if chosen is not None:
            await self._start({"file": chosen["name"]})

    async def resume(self, mission: str) -> None:
        """Take up an earlier mission at its first unfinished step."""
        await self._start({"resume": mission})

    async def plan(self) -> None:
        """Ask for the plan of the chosen mission; nothing moves."""
        chosen, client = self._chosen, self._mirror.client
        if chosen is None:
            return
        asked = {"file": chosen["name"], "dry_run": True}
        task = await attempt(lambda: client.post(f"/v1/missions?wait_s={PLAN_S}", asked))
        if task is not None and task["result"] is not None and task["result"].get("plan") is not None:
            self._plan = (chosen["name"], task["result"]["plan"])

    async def cancel(self) -> None:
        """Cancel the task that runs."""
        active = self._mirror.active
        if active is not None:
            await attempt(lambda: self._mirror.client.post(f"/v1/tasks/{active['id']}/cancel"))
            self._mirror.hurry()

    async def pause(self) -> None:
        """Let the task that runs stand still before its next step; one that is paused goes on."""
        active = self._mirror.active
        if active is not None:
            deed = "pause" if active["pause"] == "no" else "go-on"
            await attempt(lambda: self._mirror.client.post(f"/v1/tasks/{active['id']}/{deed}"))
            await self._mirror.ask_now("tasks")

    def choices(self) -> str:
        """Return the mission files as buttons."""
        chosen, files = self._chosen, self._files()
        return "".join(
            f'<button type="button" class="choice" data-mission="{attribute(one["name"])}" '
            f'aria-pressed="{"true" if one is chosen else "false"}"><b>{attribute(one["name"])}</b> '
            f"<span>{attribute(one['title'])}</span></button>"
            for one in files
        ) or f'<p class="quiet">{say("missions.no_files")}</p>'  # fmt: skip

    def steps(self) -> str:
        """Return what the chosen mission does, or why it cannot be run."""
        chosen = self._chosen
        if chosen is None:
            return ""
        if chosen["problem"] is not None:
            told = say("missions.unfit", problem=chosen["problem"], hint=chosen["hint"])
            return f'<p class="bad">{attribute(told)}</p>'
        return f"<h3>{say('missions.steps_of')}</h3>" + step_list(chosen["steps"], self._mirror.panel)

    def edit(self) -> str:
        """Return the ways to the editor, for the chosen mission and for a new one."""
        chosen, path = self._chosen, "/mission-editor"
        ways = [] if chosen is None else [(f"{path}?mission={attribute(chosen['name'])}", say("missions.edit"))]
        links = "".join(f'<a href="{link}">{told}</a> ' for link, told in [*ways, (path, say("missions.new"))])
        return f'<p class="row">{links}</p>'

    def planned(self) -> str:
        """Return the plan of the last dry run as a table."""
        return "" if self._plan is None else plan_table(*self._plan, self._mirror.panel)

    async def _start(self, body: dict[str, Any]) -> None:
        self._plan = None
        await attempt(lambda: self._mirror.client.post("/v1/missions", body))
        self._mirror.hurry()

    def _files(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self._mirror.said("mission_files", {"files": []})["files"]
        return found


def plan_table(mission: str, plan: dict[str, Any], panel: Panel | None) -> str:
    """Return the stations of a plan with their times, and whether it can be done."""
    heading = say("plan.heading", mission=mission)
    lines = [f"<h3>{attribute(heading)}</h3>"]
    if plan["is_possible"]:
        times = {"minutes": plan["expected_s"], "ways": plan["ways_s"], "contact": plan["contact_s"]}
        told = say("plan.possible", **{key: lasting(value) for key, value in times.items()})
        lines.append(f"<p>{attribute(told)}</p>")
    else:
        lines.append(f'<p class="bad">{say("plan.impossible")}</p>')
    lines.append(f'<p><a href="{PATHS["cell"]}">{attribute(say("plan.in_3d"))}</a></p>')
    if not plan["located"]:
        lines.append(f'<p class="quiet">{say("plan.not_located")}</p>')
    rows = []
    for number, one in enumerate(plan["stations"], start=1):
        way = say("plan.way", seconds=f"{one['way_s']:.1f}") if one["problem"] is None else one["problem"]
        look = "" if one["problem"] is None else ' class="bad"'
        where = attribute(_station(one["what"], panel))
        rows.append(
            f"<tr><td>{number}</td><td>{where}</td><td>{attribute(one['step'])}</td><td{look}>{attribute(way)}</td></tr>"
        )
    return "".join(lines) + table(["number", "station", "step_name", "way"], rows, name=heading)


def _station(what: str, panel: Panel | None) -> str:
    names = what.removeprefix("close-up of ")
    return did("close-up", names, panel) if names != what else word("plan.station", what)


def _progress(mirror: Mirror) -> str:
    task = mirror.active
    if task is None:
        return f'<p class="quiet">{say("missions.idle")}</p>'
    percent = round(100 * task["fraction"])
    request = task["request"]
    what = " ".join(part for part in (word("verb", task["verb"]), request.get("file") or request.get("resume")) if part)
    line = say("missions.running", what=what[:1].upper() + what[1:], percent=percent)
    pause = {"asked": say("missions.pauses"), "held": say("missions.paused")}.get(task["pause"], "")
    return f'<p>{attribute(line)} {attribute(pause)}</p><div class="bar"><i style="width:{percent}%"></i></div>'


def steps(mirror: Mirror) -> str:
    """Return the steps of the task that runs, or of the last one, the newest first, with what went wrong and what to do."""
    task = mirror.active or next((one for one in mirror.tasks if not is_plan(one)), None)
    if task is None:
        return f'<p class="quiet">{say("missions.no_tasks")}</p>'
    lines, last = [], ""
    for event in mirror.events.get(task["id"], []):
        told = did(event["step"], event["detail"], mirror.panel)
        if event["kind"] == "progress" and told != last:
            lines.append(f"<li><time>{clock(event['time_s'])}</time><span>{attribute(told)}</span></li>")
            last = told
    if task["state"] in FINAL:
        lines.append(f'<li><span class="{LOOKS.get(task["state"], "")}">{word("state", task["state"])}</span></li>')
    problem = task["problem"]
    if problem is not None:
        lines.append(f"<li>{attribute(say('try', hint=problem['hint']))}</li>")
        lines.append(f'<li class="bad">{attribute(problem["detail"])}</li>')
    return f'<ol class="steps" tabindex="0" aria-label="{say("missions.steps")}">{"".join(reversed(lines))}</ol>'


def _reports(mirror: Mirror) -> str:
    can_resume = mirror.active is None and mirror.may(Role.OPERATOR)
    rows = [report_row(mission, can_resume=can_resume) for mission in _earlier(mirror)[:10]]
    return table(REPORT_COLUMNS, rows, name=say("missions.reports"), empty=say("missions.no_reports"))


def _earlier(mirror: Mirror) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = mirror.said("missions", {"missions": []})["missions"]
    return found


def began_s(mission: dict[str, Any]) -> float | None:
    """Return when a mission began, seconds since 1970; None if its report does not say."""
    try:
        return datetime.fromisoformat(mission["started"] or "").timestamp()
    except ValueError:
        return None


def report_row(mission: dict[str, Any], *, can_resume: bool = False) -> str:
    """Return the row of an earlier mission; with a button to take it up where something is left and nothing runs."""
    link, step = mission["report_url"], mission["unfinished_step"]
    shown = (
        f'<a href="/relay{attribute(link)}" target="_blank" rel="noopener">{say("last.report")}</a>' if link else "–"
    )
    state = {True: "succeeded", False: "failed", None: None}[mission["succeeded"]]
    if state == "failed" and step is not None:
        state = "unfinished"
    chip = "–" if state is None else f'<span class="chip {LOOKS.get(state, "")}">{word("state", state)}</span>'
    again = ""
    if can_resume and step is not None:
        told = attribute(say("missions.resume", step=step))
        again = f'<button type="button" class="plain" data-resume="{attribute(mission["name"])}">{told}</button>'
    title = attribute(mission["title"] or mission["name"])
    return f"<tr><td>{clock(began_s(mission))}</td><td>{title}</td><td>{chip}</td><td>{shown}</td><td>{again}</td></tr>"


def _tasks(mirror: Mirror) -> str:
    return table(
        ["started", "task", "state", "step", "took"],
        [_task_row(task) for task in mirror.tasks[:15]],
        name=say("missions.tasks"),
        empty=say("missions.no_tasks"),
    )


def _task_row(task: dict[str, Any]) -> str:
    problem = task["problem"]
    step = problem["detail"] if problem is not None else did(task["step"], "", None)
    took = "–"
    if task["started_s"] is not None:
        took = f"{(task['ended_s'] or time.time()) - task['started_s']:.0f} s"
    state = f'<span class="chip {LOOKS.get(task["state"], "")}">{word("state", task["state"])}</span>'
    what = say("plan.task") if is_plan(task) else word("verb", task["verb"])
    return (
        f"<tr><td>{clock(task['created_s'])}</td><td>{attribute(what)}</td><td>{state}</td>"
        f"<td>{attribute(step or '–')}</td><td>{took}</td></tr>"
    )
