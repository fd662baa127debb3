"""What a deed shall reach; asked before anything moves, so that a request that makes no sense moves nothing."""

from __future__ import annotations

from hal.config import Cell
from hal.entry_points import registered
from hal.errors import InvalidRequest
from hal.kinds import SKILLS, has_part
from hal.panel import PanelObject
from service.schema.requests import ActionBody, InspectRequest, ManipulateRequest, MissionRequest, RecogniseRequest


def target_of(panel_object: PanelObject, body: ActionBody) -> str | float:
    """What shall be reached; the usual deed of its kind when nothing is asked.

    Raises:
        InvalidRequest: the object cannot be worked, or has no such state or value.
    """
    goal = panel_object.goal
    if goal is None or not has_part(SKILLS, panel_object.kind):
        raise InvalidRequest(
            f"{panel_object.name} is a {panel_object.kind}, which cannot be worked: it is read only",
            hint=f"kinds that can be: {', '.join(registered(SKILLS))}",
        )
    for other in sorted({"state", "value", "angle_rad"} - {goal.key}):  # what is meant must not be guessed
        if getattr(body, other) is not None:
            hint = f"send {{'object': '{panel_object.name}', '{goal.key}': ...}}"
            what = f"{panel_object.name} is a {panel_object.kind}: it takes {goal.key}, not {other}"
            raise InvalidRequest(what, hint=hint)
    return goal.checked(panel_object.name, getattr(body, goal.key))


def text_of(panel_object: PanelObject, target: str | float) -> str:
    """A target as a report has it."""
    return str(target) if panel_object.goal is None else panel_object.goal.text(target)


def check_manipulate(cell: Cell, request: ManipulateRequest) -> None:
    """Raise `InvalidRequest` for a deed that makes no sense on the cell's panel."""
    target_of(cell.panel.object(request.object), request)


def check_mission(cell: Cell, request: MissionRequest) -> None:
    """Raise `InvalidRequest` when one of the deeds makes no sense on the cell's panel."""
    for body in request.actions or ():
        target_of(cell.panel.object(body.object), body)


def check_looked_for(cell: Cell, request: InspectRequest | RecogniseRequest) -> None:
    """Raise `InvalidRequest` for an object that the cell's panel does not have, unless a stored image is asked about."""
    if request.image is None:
        for name in request.objects or ():
            cell.panel.object(name)
