"""The panel inside the engine: bodies, printed faces, lamps, mechanisms, and their true states."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.config import CableSection, Cell
from hal.panel import Panel, Tag
from hal.simulated import ObjectTruth
from simbackend import textures
from simbackend.bodies.body import body_of
from simbackend.bodies.parts import PAINT, Quad, Shine, light_urdf, robot
from simbackend.draws import Draws
from simbackend.mechanisms import JOINT, Detent, Friction, Mechanism, Spring
from simbackend.panel_state import Built, build
from simbackend.scene import Scene
from simbackend.urdf import Colour
from simbackend.wire import Emitter

NEAR_M = 0.14  # mechanisms are active while the finger tips are nearer than this
# Parts of the panel collide with the arm only, never with one another (a button moves into its plate).
ARM_GROUP, PANEL_GROUP = 1, 2
LENS = 0  # the link of a border light that shines
LIGHT_GLOW = (1.0, 0.97, 0.88)
LIGHT_OFF = (0.42, 0.42, 0.40)
DIM = 0.35
TAG_LIFT_M = 1e-4  # least height of a print above the plate's own print, so that it is drawn in front of it
LAMP_RADIANCE = 3.2  # a lit red lamp must be brighter than the plate in a grey image too
LIGHT_RADIANCE = 5.0
GLOW: dict[str, tuple[float, float, float]] = {
    "red": (1.0, 0.12, 0.08),
    "green": (0.15, 1.0, 0.30),
    "amber": (1.0, 0.65, 0.10),
    "blue": (0.20, 0.45, 1.0),
    "white": (1.0, 1.0, 0.95),
}


class PanelWorld:
    """All bodies of the panel, and the room behind it."""

    def __init__(self, engine: Any, cell: Cell, draws: Draws, folder: Path) -> None:
        self.engine = engine
        self.panel: Panel = cell.built_panel or cell.panel
        self.folder = folder
        self.base_from_panel = draws.panel_pose(cell.file.workspace, cell.file.simulation)
        self.built = {built.panel_object.name: built for built in build(self.panel, draws)}
        self.bodies: dict[str, int] = {}
        self.mechanisms: dict[str, Mechanism] = {}
        self.lights_on = [0.0] * len(self.panel.lights)
        self._first_body = engine.getNumBodies()
        self._light_names = frozenset(light.name for light in self.panel.lights)
        self._pictures: list[tuple[Quad, RigidTransform]] = []
        self._first_picture: dict[str, int] = {}
        self._load_room(cell.file.workspace.floor_z_m)
        self._load_plate(draws)
        for tag in self.panel.tags:
            self._print_tag(tag, self.panel.tolerances.tag_m * draws.stream(f"tag/{tag.name}").standard_normal(2))
        self._shines: dict[str, Shine] = {}
        self.light_places: list[tuple[float, float, float]] = []
        for light in self.panel.lights:
            jitter = self.panel.tolerances.light_m * draws.stream(f"light/{light.name}").standard_normal(3)
            self._load_light(light, jitter)
        for built in self.built.values():
            self._load_object(built)
        for k, cable in enumerate(cell.file.simulation.cables):
            self._load_cable(k, cable)
        self._keep_apart()
        self.scene = self._draw_up()
        self.lamps_on = {name: self.built[name].start.is_on for name in self._shines}
        for name, on in self.lamps_on.items():
            self.paint_lamp(name, on=on)
        for light in self.panel.lights:
            self._paint(light.name, LIGHT_OFF, 1.0, on=False)
        self._presses = dict.fromkeys(self.mechanisms, 0)
        self.points = {
            name: tuple(self.object_pose(self.built[name]).translation.tolist())
            for name, mechanism in self.mechanisms.items()
            if not isinstance(mechanism, Friction)
        }
        self._alive: set[str] = set()
        self.dead: set[str] = set()  # lamps and border lights that stay dark
        self._order: list[str] = []
        for mechanism in self.mechanisms.values():
            mechanism.lock()
        for name, value in cell.file.simulation.shows.items():
            self.show(name, value)

    # -- building -------------------------------------------------------------------------------------------------

    def _load_room(self, floor_z_m: float) -> None:
        """Load the floor that the arm stands on."""
        engine = self.engine
        floor = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=[2, 2, 0.05])
        look = engine.createVisualShape(engine.GEOM_BOX, halfExtents=[2, 2, 0.05], rgbaColor=[0.28, 0.29, 0.30, 1])
        self.bodies["_floor"] = engine.createMultiBody(0, floor, look, basePosition=[0, 0, floor_z_m - 0.05])

    def _load_plate(self, draws: Draws) -> None:
        """Load the plate, whose edges are where the file has them up to `tolerances.edge_m`."""
        engine, panel = self.engine, self.panel
        edges_m = panel.tolerances.edge_m * draws.stream("plate/edges").standard_normal(4)  # right, top, left, bottom
        size_m = (panel.width_m + edges_m[0] + edges_m[2], panel.height_m + edges_m[1] + edges_m[3])
        middle_m = ((edges_m[0] - edges_m[2]) / 2, (edges_m[1] - edges_m[3]) / 2)
        half = [size_m[0] / 2, size_m[1] / 2, panel.thickness_m / 2]
        solid = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=half)
        look = engine.createVisualShape(
            engine.GEOM_BOX, halfExtents=[half[0], half[1], half[2] - 2e-4], rgbaColor=[0.5, 0.5, 0.5, 1]
        )
        pose = self.base_from_panel * RigidTransform.from_translation([*middle_m, -half[2]])
        self.bodies["_plate"] = engine.createMultiBody(0, solid, look, *_pose(pose))
        picture = Quad(pixels=textures.plate(panel, size_m, middle_m), size_m=size_m, centre_m=(*middle_m, 0))
        self._pictures.append((picture, self.base_from_panel))

    def _print_tag(self, tag: Tag, jitter_m: Any) -> None:
        """Put the print of a tag onto the plate; it has no thickness and nothing collides with it."""
        x, y, z = tag.position_m
        place = [x + jitter_m[0], y + jitter_m[1], max(z, TAG_LIFT_M)]
        turn = Rotation.from_rotvec([0.0, 0.0, -tag.angle_rad])
        pixels, side_m = textures.tag(tag)
        picture = Quad(pixels=pixels, size_m=(side_m, side_m), centre_m=(0, 0, 0))
        self._pictures.append((picture, self.base_from_panel * RigidTransform.from_components(place, turn)))

    def _load_cable(self, number: int, cable: CableSection) -> None:
        """Load a cable as stiff rods from point to point, with spheres at the joints."""
        engine, radius = self.engine, cable.radius_m
        colour = [cable.gray] * 3 + [1]
        ball = engine.createCollisionShape(engine.GEOM_SPHERE, radius=radius)
        round_look = engine.createVisualShape(engine.GEOM_SPHERE, radius=radius, rgbaColor=colour)
        points = self.base_from_panel.apply(np.array(cable.path_m))
        for k, point in enumerate(points):
            self.bodies[f"_cable{number}_end{k}"] = engine.createMultiBody(0, ball, round_look, point.tolist())
        for k, (a, b) in enumerate(pairwise(points)):
            length = float(np.linalg.norm(b - a))
            rod = engine.createCollisionShape(engine.GEOM_CYLINDER, radius=radius, height=length)
            look = engine.createVisualShape(engine.GEOM_CYLINDER, radius=radius, length=length, rgbaColor=colour)
            turn, _ = Rotation.align_vectors([b - a], [[0.0, 0.0, length]])
            place = ((a + b) / 2).tolist()
            self.bodies[f"_cable{number}_rod{k}"] = engine.createMultiBody(0, rod, look, place, turn.as_quat().tolist())

    def _keep_apart(self) -> None:
        """Restrict collisions of room and panel to those with the arm."""
        for body in range(self._first_body, self.engine.getNumBodies()):
            for link in range(-1, self.engine.getNumJoints(body)):
                self.engine.setCollisionFilterGroupMask(body, link, PANEL_GROUP, ARM_GROUP)

    def _draw_up(self) -> Scene:
        """Return the scene of everything visible: all bodies of the engine (with the arm) and the printed faces."""
        scene = Scene(self.engine)
        for body in range(self.engine.getNumBodies()):
            scene.add_body(body)
        for quad, pose in self._pictures:
            base_from_quad = pose * RigidTransform.from_translation(quad.centre_m)
            scene.add_picture(quad.pixels, quad.size_m, base_from_quad, is_round=quad.is_round)
        scene.compile()
        return scene

    def _load_light(self, light: Any, jitter: Any) -> None:
        x, y, z = light.position_m
        pose = self.base_from_panel * RigidTransform.from_translation([x + jitter[0], y + jitter[1], jitter[2]])
        self._load_urdf(light.name, light_urdf(light), pose)
        x, y, z = pose.apply([0, 0, z]).tolist()
        self.light_places.append((x, y, z))

    def _load_urdf(self, name: str, text: str, pose: RigidTransform, *, has_exact_cylinders: bool = False) -> int:
        path = self.folder / f"{name}.urdf"
        path.write_text(text, encoding="ascii")
        position, quaternion = _pose(pose)
        flags = self.engine.URDF_USE_INERTIA_FROM_FILE
        if has_exact_cylinders:
            flags |= self.engine.URDF_USE_IMPLICIT_CYLINDER
        body = self.engine.loadURDF(str(path), position, quaternion, useFixedBase=True, flags=flags)
        self.bodies[name] = int(body)
        return int(body)

    def _load_object(self, built: Built) -> None:
        name = built.panel_object.name
        pose = self.object_pose(built)
        body_kind = body_of(built.panel_object.kind)
        model = body_kind.model(built.panel_object, built.start)
        self._first_picture[name] = len(self._pictures)
        self._pictures += [(quad, pose) for quad in model.quads]
        if model.shine is not None:
            self._shines[name] = model.shine
        if not model.urdf:
            return
        body = self._load_urdf(name, robot(model.urdf), pose, has_exact_cylinders=model.has_exact_cylinders)
        if self.engine.getNumJoints(body):
            self.engine.resetJointState(body, JOINT, model.place)
            for link in (-1, JOINT):
                # The engine multiplies this by the pads' own friction coefficient.
                self.engine.changeDynamics(body, link, lateralFriction=1.0, jointDamping=0.0)
            self.mechanisms[name] = body_kind.mechanism(
                self.engine, body, built.panel_object, built.start, built.effort_ratio
            )

    def object_pose(self, built: Built) -> RigidTransform:
        """Return base_from_object as built."""
        x, y = built.panel_object.position_m
        dx, dy = built.offset_m
        return self.base_from_panel * RigidTransform.from_translation([x + dx, y + dy, 0.0])

    # -- running --------------------------------------------------------------------------------------------------

    def wake(self, tip_m: tuple[float, float, float]) -> None:
        """Activate the mechanisms near the finger tips; the others stay locked."""
        x, y, z = tip_m
        near = {
            name
            for name, (px, py, pz) in self.points.items()
            if (px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2 < NEAR_M**2
        }
        if near != self._alive:
            self._wake(near)

    def drive(self) -> None:
        """Drive the active mechanisms for one tick."""
        for name in self._order:
            mechanism = self.mechanisms[name]
            if isinstance(mechanism, Spring):
                mechanism.drive()
                self._work_lamp(name, mechanism)
            elif isinstance(mechanism, Detent):
                mechanism.drive()

    def _wake(self, near: set[str]) -> None:
        for name in sorted(near - self._alive):
            mechanism = self.mechanisms[name]
            if isinstance(mechanism, Spring):
                mechanism.free()
        for name in sorted(self._alive - near):
            self.mechanisms[name].lock()
        self._alive = near
        self._order = sorted(near)

    def _work_lamp(self, name: str, button: Spring) -> None:
        """Toggle the lamp at each press of its button."""
        if button.presses == self._presses[name]:
            return
        self._presses[name] = button.presses
        lamp = self.built[name].panel_object.shown_by
        if lamp in self.lamps_on:
            self.lamps_on[lamp] = not self.lamps_on[lamp] and lamp not in self.dead
            self.paint_lamp(lamp, on=self.lamps_on[lamp])

    def show(self, name: str, value: float) -> None:
        """Let an instrument or lamp show another value; see `hal.simulated.ShowsValues`. A lamp that is out stays dark."""
        built = self.built[name]
        body = body_of(built.panel_object.kind)
        start = body.showing(built.panel_object, value)
        if start is None:
            return
        self.built[name] = replace(built, start=start)
        if name in self.mechanisms:
            self.engine.resetJointState(self.bodies[name], JOINT, start.place)
            self.mechanisms[name].lock()
        elif name in self.lamps_on:
            self.lamps_on[name] = start.is_on and name not in self.dead
            self.paint_lamp(name, on=self.lamps_on[name])
        else:
            for k, quad in enumerate(body.model(built.panel_object, start).quads):
                self.scene.reprint(self._first_picture[name] + k, quad.pixels)

    def paint_lamp(self, name: str, *, on: bool) -> None:
        """Let an indicator lamp look lit or dark."""
        colour = self._shines[name].colour
        self._paint(name, GLOW[colour] if on else PAINT[colour], LAMP_RADIANCE if on else DIM, on=on)

    def _paint(self, name: str, colour: Colour, level: float, *, on: bool) -> None:
        r, g, b = colour
        body = self.bodies[name]
        link = LENS if name in self._light_names else -1
        self.scene.paint(body, link, (level * r, level * g, level * b))
        self.scene.shine(body, link, on=on)

    def switch_lights(self, on: list[bool]) -> None:
        """Switch the border lights, in the order of the panel file."""
        for i, (light, lit) in enumerate(zip(self.panel.lights, on, strict=True)):
            lit = lit and light.name not in self.dead  # noqa: PLW2901 - a dead light is never lit
            if bool(self.lights_on[i]) != lit:
                self.lights_on[i] = float(lit)
                self._paint(light.name, LIGHT_GLOW if lit else LIGHT_OFF, LIGHT_RADIANCE if lit else 1.0, on=lit)

    def emitters(self) -> tuple[Emitter, ...]:
        """Return everything that shines now."""
        lit = [
            Emitter(colour=LIGHT_GLOW, position_m=place, radius_m=light.radius_m, is_border_light=True)
            for light, place, on in zip(self.panel.lights, self.light_places, self.lights_on, strict=True)
            if on
        ]
        for name, on in self.lamps_on.items():
            if on:
                shine = self._shines[name]
                place = self.object_pose(self.built[name]).apply([0, 0, shine.height_m])
                lit.append(
                    Emitter(
                        colour=GLOW[shine.colour],
                        position_m=(float(place[0]), float(place[1]), float(place[2])),
                        radius_m=shine.radius_m,
                        is_border_light=False,
                    )
                )
        return tuple(lit)

    def truth(self) -> tuple[ObjectTruth, ...]:
        """Return the true state of each object at this tick, for the judge."""
        return tuple(
            body_of(built.panel_object.kind).truth(
                built.panel_object, built.start, self.mechanisms.get(name), is_lit=self.lamps_on.get(name, False)
            )
            for name, built in self.built.items()
        )


def _pose(pose: RigidTransform) -> tuple[list[float], list[float]]:
    return pose.translation.tolist(), pose.rotation.as_quat().tolist()
