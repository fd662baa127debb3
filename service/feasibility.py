"""What is asked of controls, and whether it is possible at all: faults of a request are found before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from hal.config import Cell
from hal.devices import DeviceKind
from hal.entry_points import registered
from hal.errors import CellError, InvalidRequest, OutOfReach, Unsupported
from hal.frames import frame_tree
from hal.geometry import identity
from hal.panel import NumberGoal, PanelObject
from hal.panel.kinds import SKILLS, has_part
from manipulation import Hand, Kinematics, out_of_reach_m, rehearse
from service.processes.connection import CellConnection
from service.schema.requests import ActionBody, ManipulateRequest, MissionRequest
from service.world_model import WorldModel, expected_panel

Arm = Callable[[], Kinematics | None]


def arm_of(connection: CellConnection, world: WorldModel) -> Kinematics | None:
    """Return the kinematics of the cell's arm; None if it has none, or does not run."""
    arms = connection.cell.names_of(DeviceKind.ARM)
    try:
        return world.kinematics(lambda: Kinematics.of(connection.device(arms[0]).capabilities())) if arms else None
    except CellError:
        return None


def target_of(panel_object: PanelObject, body: ActionBody) -> str | float:
    """Return the target of an action; the usual target of the kind when the request names none.

    Raises:
        InvalidRequest: the object cannot be operated, or has no such state or value.
    """
    goal = panel_object.goal
    if goal is None or not has_part(SKILLS, panel_object.kind):
        raise InvalidRequest(
            f"{panel_object.name} is a {panel_object.kind}, which cannot be operated: it is read only",
            hint=f"kinds that can be: {', '.join(registered(SKILLS))}",
        )
    for other in sorted({"state", "value", "angle_rad"} - {goal.key}):  # refused, because its meaning would be a guess
        if getattr(body, other) is not None:
            hint = f"send {{'object': '{panel_object.name}', '{goal.key}': ...}}"
            what = f"{panel_object.name} is a {panel_object.kind}: it takes {goal.key}, not {other}"
            raise InvalidRequest(what, hint=hint)
    return goal.checked(panel_object.name, getattr(body, goal.key))


def text_of(panel_object: PanelObject, target: str | float) -> str:
    """Return a target as text for reports."""
    return str(target) if panel_object.goal is None else panel_object.goal.text(target)


def check_manipulate(cell: Cell, request: ManipulateRequest, arm: Arm) -> None:
    """Refuse an action that is not possible on the cell's panel; see `check_actions`."""
    check_actions(cell, (request,), arm)


def check_mission(cell: Cell, request: MissionRequest, arm: Arm) -> None:
    """Refuse a mission of which an action is not possible on the cell's panel; see `check_actions`."""
    check_actions(cell, request.actions or (), arm)


def check_actions(cell: Cell, actions: Sequence[ActionBody], arm: Arm) -> None:
    """Refuse actions that are not possible, with all their faults at once.

    Goals are checked always, room for the hand and the arm's reach once the arm is known. Only what is impossible
    wherever the panel may stand is refused: the rest shows when the panel has been located.

    Raises:
        InvalidRequest: an object or a goal does not exist, or cannot be confirmed (`Unprovable`), the hand has no room
            (`NoRoom`), or the arm does not reach so far (`OutOfReach`). The details have all `faults`, by object.
        Unsupported: a stroke needs another hand.
    """
    kinematics = arm() if actions else None
    found = [(body.object, fault) for body in actions for fault in _faults(cell, body, kinematics)]
    if not found:
        return
    first = found[0][1]
    first.details["faults"] = list(dict.fromkeys(fault.what for _, fault in found))
    first.details["objects"] = list(dict.fromkeys(name for name, _ in found))
    raise first


def _faults(cell: Cell, body: ActionBody, kinematics: Kinematics | None) -> Iterator[CellError]:
    try:
        panel_object = cell.panel.object(body.object)
    except InvalidRequest as fault:
        yield fault
        return
    target: str | float | None
    try:
        target = target_of(panel_object, body)
    except InvalidRequest as fault:
        yield fault
        target = _nearest(panel_object, body)
    if kinematics is None or target is None:
        return
    try:
        rehearse(kinematics, cell.panel, Hand.of(cell.file.hand), panel_object, target)
    except (InvalidRequest, Unsupported) as fault:
        yield fault
    yield from _beyond(cell, panel_object, kinematics)


def _nearest(panel_object: PanelObject, body: ActionBody) -> float | None:
    """Return the possible number that is nearest to one outside of the object's way; None for any other fault."""
    goal = panel_object.goal
    asked = getattr(body, goal.key) if isinstance(goal, NumberGoal) else None
    return None if asked is None or not isinstance(goal, NumberGoal) else min(max(asked, goal.low), goal.high)


def _beyond(cell: Cell, panel_object: PanelObject, kinematics: Kinematics) -> Iterator[OutOfReach]:
    """Give a fault if the control is out of reach wherever the cell file allows the panel to stand."""
    workspace, pose = cell.file.workspace, expected_panel(cell).parent_from_child
    grippers = cell.names_of(DeviceKind.GRIPPER)
    if not grippers:
        return
    flange_from_grip = frame_tree(cell, identity()).base_from(grippers[0]).parent_from_child
    point = np.array(panel_object.point_m)
    slack_m = np.sqrt(3.0) * (workspace.position_tolerance_m + workspace.angle_tolerance_rad * np.linalg.norm(point))
    beyond_m = out_of_reach_m(kinematics, flange_from_grip, pose.apply(point)) - slack_m
    if beyond_m > 0.0:
        yield OutOfReach(
            f"{panel_object.name} is beyond the arm's reach by {1e3 * beyond_m:.0f} mm, wherever the panel stands within "
            "the tolerances of the cell file",
            hint="move the panel nearer to the arm, or correct [workspace] in the cell file",
            object=panel_object.name,
            beyond_mm=round(1e3 * float(beyond_m), 1),
        )
