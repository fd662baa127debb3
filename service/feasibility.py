"""What is asked of controls, and whether it is possible at all: faults of a request are found before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import CellError, InvalidRequest, OutOfReach, Unsupported
from hal.frames import frame_tree
from hal.geometry import identity
from hal.panel import NumberGoal, Panel, PanelObject, Shown
from manipulation import Hand, Kinematics, out_of_reach_m, rehearse
from perception.vision import ObjectReading
from service.missions.check import target_of
from service.missions.files import mission_of
from service.missions.progress import Progress
from service.processes.connection import CellConnection
from service.schema.mission_file import SetStep
from service.schema.mission_request import MissionRequest
from service.schema.requests import ActionBody, ManipulateRequest
from service.world_model import WorldModel, expected_panel

__all__ = [
    "arm_of",
    "check_actions",
    "check_manipulate",
    "check_mission",
    "other_than_shown",
    "target_of",
    "text_of",
    "usual_actions",
]

Arm = Callable[[], Kinematics | None]


def arm_of(connection: CellConnection, world: WorldModel) -> Kinematics | None:
    """Return the kinematics of the cell's arm; None if it has none, or does not run."""
    arms = connection.cell.names_of(DeviceKind.ARM)
    try:
        return world.kinematics(lambda: Kinematics.of(connection.device(arms[0]).capabilities())) if arms else None
    except CellError:
        return None


def text_of(panel_object: PanelObject, target: str | float) -> str:
    """Return a target as text for reports."""
    return str(target) if panel_object.goal is None else panel_object.goal.text(target)


def usual_actions(panel: Panel, readings: Mapping[str, ObjectReading]) -> tuple[ActionBody, ...]:
    """Return one action for each kind with a mission rank: change the state or value of its best-ranked object."""
    ranked = [(one.mission_rank, one) for one in panel.objects if one.mission_rank is not None]
    first: dict[str, PanelObject] = {}
    ranked = [(rank, one) for rank, one in ranked if not one.forbidden and not one.confirm]
    for _, panel_object in sorted(ranked, key=lambda pair: pair[0]):
        first.setdefault(panel_object.kind, panel_object)
    return tuple(other_than_shown(panel_object, readings) for panel_object in first.values())


def other_than_shown(panel_object: PanelObject, readings: Mapping[str, ObjectReading]) -> ActionBody:
    """Return the action that changes the present state or value of the object, or of the object that shows it."""
    reading, goal = readings.get(panel_object.shown_by), panel_object.goal
    if goal is None:
        raise InvalidRequest(f"{panel_object.name} is read only", hint="leave it out of the mission")
    shown = Shown() if reading is None else Shown(value=reading.value, state=reading.state, text=reading.text)
    return ActionBody.model_validate({"object": panel_object.name, goal.key: goal.other_than(shown)})


def check_manipulate(cell: Cell, request: ManipulateRequest, arm: Arm) -> None:
    """Refuse an action that is not possible on the cell's panel; see `check_actions`."""
    check_actions(cell, (request,), arm)


def check_mission(cell: Cell, request: MissionRequest, arm: Arm) -> None:
    """Refuse a mission of which an action is not possible on the cell's panel; see `check_actions`.

    A mission that is taken up is looked at when its task begins.
    """
    if request.resume is not None:
        return
    checked = mission_of(request, cell)
    steps = Progress(mission=checked.mission, library=checked.library).all_steps()
    set_steps = [step for step in steps if isinstance(step, SetStep) and step.object is not None and not step.other]
    check_actions(cell, [step.action() for step in set_steps], arm)


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
