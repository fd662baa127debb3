"""`panelwright inspect` and `panelwright set`: read and work single objects of the panel of a running service."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from hal.errors import InvalidRequest
from service.client import Client
from service.commands.common import Url, UrlDefault, client_of, console
from service.commands.own_cell import run_task

if TYPE_CHECKING:
    from hal.panel import Panel, PanelObject


def inspect(
    objects: Annotated[
        list[str] | None, typer.Argument(help="Objects of the panel; all of them if none is given.")
    ] = None,
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print the readings as the API gives them.")] = False,
    url: Url = UrlDefault,
) -> None:
    """Drive the camera to objects, read them, and print what they show; nothing is touched.

    The exit code is 1 when the task failed or an object could not be read.
    """
    client = client_of(url)
    panel = _panel(client)
    asked = tuple(objects or ())
    for name in asked:
        _object(panel, name)
    task = run_task(client, "/v1/inspect", {"objects": list(asked)} if asked else {})
    if task["state"] != "succeeded":
        raise typer.Exit(1)
    newest = client.get("/v1/history")["newest"]
    found = [one for one in newest if one["task"] == task["id"]]
    if as_json:
        console.print_json(json.dumps(found))
    else:
        console.print(_table(panel, found))
    raise typer.Exit(0 if found and all(one["quality"] == "valid" for one in found) else 1)


def set_object(
    name: Annotated[str, typer.Argument(metavar="OBJECT", help="Object of the panel.")],
    target: Annotated[
        str | None, typer.Argument(help="A state, or a number in the object's unit (degrees for an angle).")
    ] = None,
    *,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves.")] = False,
    url: Url = UrlDefault,
) -> None:
    """Work one object until it shows the target, after a yes, and look whether it got there; the exit code tells."""
    client = client_of(url)
    one = _object(_panel(client), name)
    body = {"object": name, **body_of(one, target)}
    told = "" if target is None else f" to {target}"
    if not yes and not typer.confirm(f"The arm drives to {one.label or name} and works it{told}. Is the cell clear?"):
        raise typer.Exit(1)
    if one.confirm:
        body["confirm"] = typer.prompt(f"The panel file asks for the name of {name} again")
    task = run_task(client, "/v1/manipulate", body)
    raise typer.Exit(0 if task["state"] == "succeeded" and task["result"]["confirmed"] is not False else 1)


def body_of(one: PanelObject, target: str | None) -> dict[str, Any]:
    """Return the part of a request that names the target of an object.

    Raises:
        InvalidRequest: the object is only read, may not be worked, or has no such target.
    """
    from hal.panel import NumberGoal

    goal = one.goal
    if goal is None or one.forbidden:
        why = "is only read" if goal is None else "may not be worked: the panel file forbids it"
        raise InvalidRequest(f"{one.name} {why}", hint="choose another object")
    if isinstance(goal, NumberGoal):
        is_angle = goal.key == "angle_rad"
        low, high = (round(math.degrees(v)) if is_angle else v for v in (goal.low, goal.high))
        try:
            value = float(target or "")
        except ValueError:
            value = math.nan
        if not low - 1e-9 <= value <= high + 1e-9:
            unit = "°" if is_angle else f" {goal.unit}"
            raise InvalidRequest(f"{target!r} is no target of {one.name}", hint=f"give {low:g} to {high:g}{unit}")
        return {goal.key: min(goal.high, max(goal.low, math.radians(value))) if is_angle else value}
    if len(goal.states) == 1 and target in (None, goal.states[0]):
        return {}
    target = goal.usual if target is None else target
    if target not in goal.states:
        raise InvalidRequest(f"{target!r} is no state of {one.name}", hint=f"give one of: {', '.join(goal.states)}")
    return {goal.key: target}


def _panel(client: Client) -> Panel:
    from hal.panel import Panel

    return Panel.model_validate_json(json.dumps(client.get("/v1/panel")))


def _object(panel: Panel, name: str) -> PanelObject:
    for one in panel.objects:
        if one.name == name:
            return one
    names = ", ".join(one.name for one in panel.objects)
    raise InvalidRequest(f"panel {panel.name} has no object {name!r}", hint=f"its objects: {names}")


def _table(panel: Panel, found: list[dict[str, Any]]) -> Table:
    table = Table("object", "shows", "sigma", "confidence", box=None, pad_edge=False)
    for one in found:
        if one["quality"] != "valid":
            table.add_row(escape(one["object"]), f"[yellow]not readable: {escape(one['cause'])}[/]", "", "")
            continue
        factor = math.degrees(1.0) if panel.object(one["object"]).value_is_angle else 1.0
        unit = "°" if factor != 1.0 else one["unit"]
        value = one["state"] or (one["text"] or "").strip() or f"{factor * one['value']:.4g}"
        shown = value if one["state"] else f"{value} {unit}".rstrip()
        sigma = "" if one["sigma"] is None or one["state"] else f"{factor * one['sigma']:.2g}"
        table.add_row(escape(one["object"]), escape(shown), sigma, f"{100 * one['confidence']:.0f} %")
    return table
