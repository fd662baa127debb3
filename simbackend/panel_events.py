"""What happens to the simulated panel while the world runs: it moves, or a part of it is blocked, dark or gone."""

from __future__ import annotations

from scipy.spatial.transform import RigidTransform, Rotation

from hal.simulated_events import EventSection
from simbackend.events import displacement
from simbackend.panel_world import PanelWorld

REMOVED_M = 5.0  # below the floor, where a part that was taken away is kept


def apply(panel: PanelWorld, event: EventSection, begun: RigidTransform, fraction: float) -> None:
    """Apply an event to the panel.

    Args:
        begun: base_from_panel when the event began.
        fraction: of a motion, 0 to 1.
    """
    name = str(event.object)
    match event.kind:
        case "panel-moves":
            move_to(panel, begun * displacement(event, fraction))
        case "blocked":
            panel.mechanisms[name].block()
        case "lamp-out":
            put_out(panel, name)
        case "missing":  # its print stays on the plate
            _shift(panel, panel.bodies[name], RigidTransform.from_translation([0.0, 0.0, -REMOVED_M]))


def move_to(panel: PanelWorld, base_from_panel: RigidTransform) -> None:
    """Set the panel with everything on it to another pose; moving parts keep their places on it."""
    moved = base_from_panel * panel.base_from_panel.inv()
    for name, body in panel.bodies.items():
        if name != "_floor":
            _shift(panel, body, moved)
    panel.scene.shift_prints(moved)
    panel.points = {name: _point(moved, place) for name, place in panel.points.items()}
    panel.light_places = [_point(moved, place) for place in panel.light_places]
    panel.base_from_panel = base_from_panel


def put_out(panel: PanelWorld, name: str) -> None:
    """Let an indicator lamp or a border light be dark from now on."""
    panel.dead.add(name)
    if name in panel.lamps_on:
        panel.lamps_on[name] = False
        panel.paint_lamp(name, on=False)
    else:
        panel.switch_lights([bool(on) for on in panel.lights_on])


def _shift(panel: PanelWorld, body: int, moved: RigidTransform) -> None:
    position, quaternion = panel.engine.getBasePositionAndOrientation(body)
    pose = moved * RigidTransform.from_components(position, Rotation.from_quat(quaternion))
    panel.engine.resetBasePositionAndOrientation(body, pose.translation.tolist(), pose.rotation.as_quat().tolist())


def _point(moved: RigidTransform, place: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = moved.apply(place).tolist()
    return x, y, z
