"""Simulated depth images of furnished rooms: walls, soft furniture, shelves, tables and things on them.

They replace real frames of rooms and follow their way of labelling: rounded edges beyond 5 mm and loose cushions have
no label, faces that bulge by 1 % are planes, each cushion of a sofa has its own label, a surface that an occluder
divides keeps one label, and skirting boards, picture frames, edges of boards and poles are not outlined.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.range_sensors import FINE, LEAST_PIXELS, Case, case_seen, sensor_model
from benchmarks.range_soft import STRAIGHT, UP, SoftBox, drawn, plane, sofa, soft_box
from hal.arrays import Array

VIEWS = ("structured", "tof", FINE)
NARROWEST_MM = 50.0  # narrowest face that people outline
OFF_WALL_MM = 600.0  # least distance of the camera from the walls
GAP_MM = (60.0, 250.0)  # between pieces of furniture


@dataclass(slots=True, kw_only=True)
class Room:
    """Contents of a room, in millimetres: the back wall is y = 0, the floor z = 0, the camera is at negative y.

    Attributes:
        gen, rng: generator module that builds primitives, and the random generator.
        plain: primitives as `gen` draws them.
        soft: boxes with rounded edges and bulged faces.
    """

    gen: ModuleType
    rng: np.random.Generator
    plain: list[dict[str, Any]] = field(default_factory=list)
    soft: list[SoftBox] = field(default_factory=list)

    def between(self, low: float, high: float) -> float:
        """Return a random number between two."""
        return float(self.rng.uniform(low, high))

    def box(self, name: str, at: Any, size: Any, turn: Array = STRAIGHT) -> None:
        """Add a box of `size` with sharp edges that stands centred on the point `at`."""
        size = np.asarray(size, float)
        self.plain += self.gen.box(np.asarray(at, float) + UP * (size[2] / 2), size, turn, name)

    def carton(self, name: str, at: Any, size: Any, turn: Array, radius: float, bulge: float) -> None:
        """Add a soft box of `size` that stands centred on the point `at`."""
        centre = np.asarray(at, float) + UP * (size[2] / 2)
        self.soft.append(soft_box(self.rng, name, centre, size, turn, radius, bulge))

    def can(self, name: str, at: Any, radius: float, height: float) -> None:
        """Add a cylinder that stands on the point `at`."""
        self.plain += self.gen.cyl(np.asarray(at, float) + UP * (height / 2), UP, radius, height / 2, name)


def room(gen: ModuleType, sensor: str, seed: int) -> Case:
    """Return a case in the scorer's format: a room seen by one of `VIEWS`."""
    rng = np.random.default_rng([seed, VIEWS.index(sensor), 79])
    place = Room(gen=gen, rng=rng)
    half_width = rng.uniform(1500, 2300)
    _shell(place, half_width)
    _furnish(place, half_width)
    target = (rng.uniform(-0.5, 0.5) * half_width, -300.0, rng.uniform(450, 950))
    tilt, azimuth, distance = rng.uniform(1.2, 1.5), rng.uniform(-0.55, 0.55), rng.uniform(2300, 3300)
    reach, across = half_width - OFF_WALL_MM, distance * np.sin(tilt)
    azimuth = np.arcsin(np.clip(np.sin(azimuth), (-reach - target[0]) / across, (reach - target[0]) / across))
    R, t = gen.look(tilt, azimuth, distance, target)
    roll = gen.rot([0, 0, 1], rng.uniform(-0.06, 0.06))
    return _seen(place, roll @ R, roll @ t, sensor, seed)


def _seen(place: Room, R: Array, t: Array, sensor: str, seed: int) -> Case:
    """Return the room as the camera at camera_from_room (`R`, `t`) sees it."""
    gen, model = place.gen, sensor_model(sensor)
    surfaces = list(gen.to_camera(place.plain, R, t))
    clean, labels = gen.cast(surfaces, model)
    clean = np.where(np.isfinite(clean), clean, np.inf)
    for box in place.soft:
        surfaces += drawn(gen, box.moved(R, t), model, clean, labels, len(surfaces), are_edges_named=False)
    surfaces = [s | {"type": "other"} if _is_trim(s) else s for s in surfaces]
    labels = np.where(np.bincount(labels.ravel())[labels] >= LEAST_PIXELS // 4, labels, 0)
    return case_seen(clean, labels, surfaces, sensor=sensor, rng=place.rng, scene="room", seed=seed)


def _is_trim(surface: dict[str, Any]) -> bool:
    """Return whether people would not outline the surface, because it is too narrow a face or too thin a pole."""
    clip = surface.get("clip") or {}
    if clip.get("kind") == "rect":
        return bool(2 * min(clip["a"], clip["b"]) < NARROWEST_MM)
    return 2 * float(surface.get("r", np.inf)) < NARROWEST_MM


def _shell(place: Room, half_width: float) -> None:
    """Add floor, walls, ceiling, skirting boards, and one or two pictures."""
    height = place.between(2400, 2800)
    place.plain += [
        plane("floor", UP, [0, 0, 0]),
        plane("wall", [0, -1, 0], [0, 0, 0]),
        plane("left", [1, 0, 0], [-half_width, 0, 0]),
        plane("right", [-1, 0, 0], [half_width, 0, 0]),
        plane("ceiling", -UP, [0, 0, height]),
    ]
    if place.rng.random() < 0.6:
        place.box("skirting", [0, -7, 0], [2 * half_width, 14, 48])
    for k in range(int(place.rng.integers(0, 3))):
        size = np.array([place.between(350, 800), 20.0, place.between(300, 600)])
        at = np.array([(k - 0.5) * half_width + place.between(-200, 200), -10.0, place.between(1250, 1500)])
        place.box(f"picture{k}", at, size)
        _frame(place, f"picture{k}", at, size)


def _frame(place: Room, name: str, at: Array, size: Array) -> None:
    """Add four strips around a picture, in front of it."""
    thick, wide = 35.0, 40.0
    for side in (-1, 1):
        beside = np.array([side * size[0] / 2, -5, 0])
        over = np.array([0, -5, (side + 1) / 2 * size[2] - wide / 2])
        place.box(f"{name}:frame", at + beside, [wide, thick, size[2]])
        place.box(f"{name}:frame", at + over, [size[0], thick, wide])


def _furnish(place: Room, half_width: float) -> None:
    """Add furniture along the wall from left to right while there is space, and free-standing things in front of it."""
    pieces: list[Callable[[Room, float], float]] = [_sofa, _cabinet, _shelf, _desk, _armchair, _lamp]
    at = -half_width + place.between(*GAP_MM)
    for k in place.rng.permutation(len(pieces)):
        width = pieces[k](place, at)
        at += width + place.between(*GAP_MM)
        if at > half_width - 400:
            break
    if place.rng.random() < 0.6:
        _coffee_table(place)
    for k in range(int(place.rng.integers(0, 3))):
        size = place.rng.uniform([200, 200, 150], [450, 350, 400])
        at_floor = [place.between(-0.7, 0.7) * half_width, -place.between(1000, 1500), 0]
        turn = place.gen.Rz(place.between(0, 3))
        place.carton(f"carton{k}", at_floor, size, turn, place.between(4, 12), place.between(0.004, 0.015))


# Each function adds furniture at the wall with its left side at x = `left` (mm) and returns the width. Furniture that
# is too wide for the rest of the wall extends into the side wall, where no camera sees it.


def _sofa(place: Room, left: float, *, is_single: bool = False) -> float:
    boxes, half = sofa(place.gen, place.rng, is_single=is_single)
    shift = np.array([left + half, -500.0 - place.between(20, 60), 0.0])
    place.soft += [box.moved(STRAIGHT, shift) for box in boxes]
    return 2 * half


def _armchair(place: Room, left: float) -> float:
    return _sofa(place, left, is_single=True)


def _cabinet(place: Room, left: float) -> float:
    """Add a plain box with things on top."""
    width, depth, height = place.between(500, 1200), place.between(350, 480), place.between(450, 1100)
    place.box("cabinet", [left + width / 2, -depth / 2, 0], [width, depth, height])
    _things(place, [left + width / 2, -depth / 2, height], width, depth, "cabinet")
    return width


def _shelf(place: Room, left: float) -> float:
    """Add a shelf with sides, back and boards, in front of any picture, with cartons and cans on the boards."""
    width, depth, height = place.between(600, 1100), place.between(280, 380), place.between(1200, 1900)
    boards, thick, off_wall = int(place.rng.integers(3, 6)), 22.0, 60.0
    x, y = left + width / 2, -off_wall - depth / 2
    for side in (-1, 1):
        place.box("shelf:side", [x + side * (width - thick) / 2, y, 0], [thick, depth, height])
    place.box("shelf:back", [x, -off_wall, 0], [width, 10, height])
    step = (height - thick) / boards
    for k in range(boards + 1):
        place.box(f"board{k}", [x, y, k * step], [width - 2 * thick, depth - 8, thick])
        if k < boards:
            _things(place, [x, y, k * step + thick], width - 60, depth, f"board{k}", step - thick - 40)
    return width


def _desk(place: Room, left: float) -> float:
    """Add a table at the wall with a screen on it and things beside it."""
    width, depth = place.between(900, 1500), place.between(550, 800)
    _table(
        place, "desk", np.array([left + width / 2, -depth / 2 - 20, 0]), [width, depth, place.between(690, 760)], 0.0
    )
    return width


def _coffee_table(place: Room) -> None:
    at = np.array([place.between(-700, 700), -place.between(1350, 1600), 0.0])
    size = [place.between(600, 1100), place.between(450, 650), place.between(350, 480)]
    _table(place, "coffee", at, size, place.between(-0.3, 0.3))


def _table(place: Room, name: str, at: Array, size: list[float], angle: float) -> None:
    """Add a board of `size` on four legs, rotated by `angle`, with things on it."""
    turn, thick, leg = place.gen.Rz(angle), place.between(18, 40), place.between(35, 48)
    for i in (-1, 1):
        for j in (-1, 1):
            foot = at + turn @ [i * (size[0] / 2 - 60), j * (size[1] / 2 - 60), 0]
            place.box(f"{name}:leg", foot, [leg, leg, size[2] - thick], turn)
    place.box(name, at + UP * (size[2] - thick), [size[0], size[1], thick], turn)
    _things(place, at + UP * size[2], 0.8 * size[0], 0.8 * size[1], name)


def _lamp(place: Room, left: float) -> float:
    """Add a floor lamp: a foot, a pole, and a shade that is a cylinder, a frustum or a ball."""
    radius, height = place.between(130, 220), place.between(1200, 1600)
    at = np.array([left + radius, -radius - 100, 0.0])
    place.can("lamp:foot", at, 140, 25)
    place.can("lamp:pole", at, 14, height)
    top, choice = at + UP * height, place.rng.random()
    if choice < 0.4:
        place.can("lamp:shade", top, radius, place.between(200, 300))
    elif choice < 0.8:
        place.plain += place.gen.cone(top, UP, radius, place.between(200, 280), "lamp:shade", top=0.6 * radius)
    else:
        place.plain += place.gen.sphere(top + UP * radius * 0.7, radius * 0.8, "lamp:ball")
    return 2 * radius


def _things(place: Room, at: Any, width: float, depth: float, name: str, tallest: float = 400.0) -> None:
    """Add boxes, mugs, bottles and balls that do not touch, on a surface `width` by `depth` around the point `at`."""
    cell = 190.0
    count = int(width // cell)
    for k in range(count):
        if place.rng.random() < 0.4:
            continue
        spot = np.asarray(at, float) + np.array([(k - (count - 1) / 2) * cell, place.between(-0.15, 0.15) * depth, 0.0])
        label, choice = f"{name}:{k}", place.rng.random()
        high = min(tallest, place.between(90, 320))
        if choice < 0.5:
            size = [place.between(80, 140), place.between(60, 130), high]
            turn = place.gen.Rz(place.between(-0.3, 0.3))
            if place.rng.random() < 0.5:
                place.box(label, spot, size, turn)
            else:
                place.carton(label, spot, size, turn, place.between(3, 12), place.between(0.004, 0.015))
        elif choice < 0.85:
            place.can(label, spot, place.between(36, 60), high)
        else:
            radius = min(place.between(40, 75), tallest / 2)
            place.plain += place.gen.sphere(spot + UP * radius, radius, label)
