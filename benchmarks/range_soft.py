"""Depth images of scenes with the imperfections of real things: bulging faces, rounded edges, upholstery and cushions.

No face of a cardboard box or a sofa is an exact plane and no edge is sharp, but people who outline surfaces label them
as planes. Boxes are signed distance fields: a box with rounded edges, each face displaced by a polynomial of low degree
that is zero on its outline, so that the box stays closed. Rays are traced by sphere tracing (Hart 1996). A point of a
rounded edge belongs to the nearest face. Throw cushions are superellipsoids that only occlude and have no label.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.range_sensors import FINE, LEAST_PIXELS, SENSORS, TABLE_HEIGHT_MM, Case, case_seen, sensor_model, stands
from hal.arrays import Array

SCENES = ("table", "room")
WALK_STEPS = 90
WALK_SHARE = 0.8  # step per distance; displaced faces are up to a fifth nearer than the box's distance field
HIT_MM = 0.02
EDGE_MM = 5.0  # depth below a face up to which its label reaches, if edges have no label
VIEWS = (*SENSORS, FINE)
UP = np.array([0.0, 0.0, 1.0])
STRAIGHT = np.eye(3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SoftBox:
    """Box with rounded edges and bulging faces, in millimetres.

    Attributes:
        name: name of the thing; its faces are called `name:x+` and so on.
        centre, turn: centre (3,) and rotation world_from_box (3, 3).
        half: half of the outer size (3,).
        radius: radius of the edges.
        bulge: (6, 4) coefficients of each face x+, x-, y+ ...: the displacement along its normal is
            (b0 + b1 s + b2 t + b3 s t)(1 - s^2)(1 - t^2) at face coordinates s, t in -1 .. 1.
        is_cushion: whether it is a superellipsoid of exponents 4 and 2 instead.
    """

    name: str
    centre: Array
    turn: Array
    half: Array
    radius: float
    bulge: Array
    is_cushion: bool = False

    def moved(self, R: Array, t: Array) -> SoftBox:
        """Return the box in another frame: x -> R x + t."""
        return replace(self, centre=R @ self.centre + t, turn=R @ self.turn)

    def distance(self, p: Array) -> Array:
        """Return (N,) distances of points (N, 3) in the box's frame; outside, `WALK_SHARE` of them is a lower bound."""
        if self.is_cushion:
            r = np.sqrt((p[:, 0] / self.half[0]) ** 4 + (p[:, 1] / self.half[1]) ** 4) + (p[:, 2] / self.half[2]) ** 2
            return np.asarray((np.sqrt(r) - 1.0) * self.half.min())
        q = np.abs(p) - (self.half - self.radius)
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        return np.asarray(outside + np.minimum(q.max(axis=1), 0.0) - self.radius - self._displacement(p))

    def faces(self, p: Array) -> NDArray[np.int64]:
        """Return the nearest face (N,), 0 to 5, of surface points (N, 3) in the box's frame; 0 for a cushion."""
        if self.is_cushion:
            return np.zeros(len(p), np.int64)
        axis = (np.abs(p) - self.half).argmax(axis=1)
        return np.asarray(2 * axis + (p[np.arange(len(p)), axis] < 0))

    def is_edge(self, p: Array) -> NDArray[np.bool_]:
        """Return (N,) whether surface points (N, 3) in the box's frame are more than `EDGE_MM` below their face."""
        q = np.abs(p) - self.half
        is_rounded = (q > -self.radius).sum(axis=1) > 1
        return np.asarray(is_rounded & (q.max(axis=1) < -EDGE_MM) & (not self.is_cushion))

    def _displacement(self, p: Array) -> Array:
        face = self.faces(p)
        axis = face // 2
        rows = np.arange(len(p))
        s, t = (np.clip(p[rows, a] / self.half[a], -1.0, 1.0) for a in ((axis + 1) % 3, (axis + 2) % 3))
        b = self.bulge[face]
        return (b[:, 0] + b[:, 1] * s + b[:, 2] * t + b[:, 3] * s * t) * (1.0 - s * s) * (1.0 - t * t)


def soft_scene(gen: ModuleType, scene: str, sensor: str, seed: int) -> Case:
    """Return a case in the scorer's format: one of `SCENES` seen by one of `VIEWS`."""
    rng = np.random.default_rng([seed, VIEWS.index(sensor), SCENES.index(scene), 78])
    plain, soft, target, distance = _table(gen, rng) if scene == "table" else _room(gen, rng)
    R, t = gen.look(
        rng.uniform(0.6, 1.1) if scene == "table" else rng.uniform(1.15, 1.4), rng.uniform(-0.5, 0.5), distance, target
    )
    roll = gen.rot([0, 0, 1], rng.uniform(-0.1, 0.1))
    R, t = roll @ R, roll @ t
    model = sensor_model(sensor)
    surfaces = list(gen.to_camera(plain, R, t))
    clean, labels = gen.cast(surfaces, model)
    clean = np.where(np.isfinite(clean), clean, np.inf)
    for box in soft:
        surfaces += drawn(gen, box.moved(R, t), model, clean, labels, len(surfaces))
    # Narrow remains of faces at an outline: people do not draw them, and each would divide the face around it.
    labels = np.where(np.bincount(labels.ravel())[labels] >= LEAST_PIXELS // 4, labels, 0)
    return case_seen(clean, labels, surfaces, sensor=sensor, rng=rng, scene=f"soft_{scene}", seed=seed)


def soft_box(
    rng: np.random.Generator, name: str, centre: Array, size: Array, turn: Array, radius: float, bulge: float
) -> SoftBox:
    """Draw a box of outer `size` with faces that bulge by `bulge` times their extent, mostly outwards."""
    size = np.asarray(size, float)
    extent = np.array([min(size[(k // 2 + 1) % 3], size[(k // 2 + 2) % 3]) for k in range(6)])
    height = bulge * extent * rng.uniform(0.5, 1.0, 6) * np.where(rng.random(6) < 0.75, 1.0, -1.0)
    shape = np.column_stack([np.ones(6), rng.normal(0.0, 0.5, (6, 3))])
    return SoftBox(
        name=name,
        centre=np.asarray(centre, float),
        turn=np.asarray(turn, float),
        half=size / 2,
        radius=min(radius, 0.45 * float(size.min())),
        bulge=height[:, None] * shape,
    )


def drawn(
    gen: ModuleType,
    box: SoftBox,
    model: dict[str, Any],
    clean: Array,
    labels: Any,
    count: int,
    *,
    are_edges_named: bool = True,
) -> list[dict[str, Any]]:
    """Draw a box in the camera frame into the images; return its surfaces, numbered after the existing `count`.

    Rounded edges get the nearest face's label or, if `are_edges_named` is false, 0 beyond `EDGE_MM`.
    """
    _, rays = gen.rays(model)
    reach = float(np.linalg.norm(box.half)) * 1.1
    length = np.linalg.norm(rays, axis=1)
    along = rays @ box.centre / length
    near = np.flatnonzero((along > 0.0) & (box.centre @ box.centre - along**2 < reach**2))
    start = (along[near] - reach) / length[near]
    origin, ray = -box.centre @ box.turn, rays[near] @ box.turn
    z = start.copy()
    alive = np.arange(near.size)
    for _ in range(WALK_STEPS):
        gap = box.distance(origin + z[alive, None] * ray[alive])
        z[alive] += WALK_SHARE * gap / length[near[alive]]
        alive = alive[(gap > HIT_MM) & (z[alive] * length[near[alive]] < along[near[alive]] + reach)]
        if alive.size == 0:
            break
    hit = z * length[near] < along[near] + reach
    hit[alive] &= False
    near, z, ray = near[hit], z[hit], ray[hit]
    front = z < clean.ravel()[near]
    near, z, ray = near[front], z[front], ray[front]
    clean.ravel()[near] = z
    points = origin + z[:, None] * ray
    is_named = are_edges_named | ~box.is_edge(points)
    labels.ravel()[near] = np.where(is_named, count + 1 + box.faces(points), 0)
    out = []
    for k in range(1 if box.is_cushion else 6):
        n = box.turn[:, k // 2] * (1.0 if k % 2 == 0 else -1.0)
        kind = "other" if box.is_cushion else "plane"
        entry = {"type": kind, "name": f"{box.name}:{'xyz'[k // 2]}{'+-'[k % 2]}", "n": n}
        out.append(entry | {"c": box.centre + n * box.half[k // 2]})
    return out


def plane(name: str, n: Any, c: Any, **clip: Any) -> dict[str, Any]:
    out: dict[str, Any] = {"type": "plane", "name": name, "n": np.asarray(n, float), "c": np.asarray(c, float)}
    return out | ({"clip": clip} if clip else {})


def _table(gen: ModuleType, rng: np.random.Generator) -> tuple[list[Any], list[SoftBox], tuple[float, ...], float]:
    """Draw floor, wall and table with cartons, cans and balls on it, a typical scene in front of a depth sensor."""
    plain = [
        plane("floor", UP, [0, 0, -TABLE_HEIGHT_MM]),
        plane("wall", [0, -1, 0], [0, rng.uniform(900, 1600), 0]),
        plane(
            "table",
            UP,
            [0, 0, 0],
            kind="rect",
            u=np.array([1.0, 0, 0]),
            a=rng.uniform(400, 800),
            b=rng.uniform(300, 600),
        ),
    ]
    soft: list[SoftBox] = []
    for k, at in enumerate(stands(rng)):
        choice = rng.random()
        if choice < 0.7:
            size = rng.uniform([70, 70, 40], [200, 170, 230])
            turn = gen.Rz(rng.uniform(0, np.pi))
            radius, bulge = rng.uniform(5, 20), rng.uniform(0.005, 0.02)
            soft.append(soft_box(rng, f"box{k}", at + UP * (size[2] / 2), size, turn, radius, bulge))
        elif choice < 0.92:
            half = rng.uniform(40, 110)
            plain += gen.cyl(at + UP * half, UP, rng.uniform(28, 62), half, f"can{k}")
        else:
            r = rng.uniform(40, 85)
            plain += gen.sphere(at + UP * r, r, f"ball{k}")
    return plain, soft, (0.0, 40.0, 30.0), rng.uniform(800, 1350)


def _room(gen: ModuleType, rng: np.random.Generator) -> tuple[list[Any], list[SoftBox], tuple[float, ...], float]:
    """Draw floor, two walls, a sofa, a cabinet, a picture and a lamp."""
    plain = [
        plane("floor", UP, [0, 0, 0]),
        plane("wall", [0, -1, 0], [0, 520, 0]),
        plane("side", [1, 0, 0], [-rng.uniform(1300, 1900), 0, 0]),
    ]
    soft, end = sofa(gen, rng)
    size = rng.uniform([300, 300, 400], [600, 450, 900])
    at = np.array([end + size[0] / 2 + rng.uniform(40, 200), 500 - size[1] / 2, size[2] / 2])
    plain += gen.box(at, size, STRAIGHT, "cabinet")
    size = np.array([rng.uniform(500, 800), 50.0, 420.0])
    plain += gen.box(np.array([rng.uniform(-400, 400), 495, 1350]), size, STRAIGHT, "picture")
    lamp = np.array([-end - 200, 300.0, 0.0])
    plain += gen.cyl(lamp + UP * 1350, UP, rng.uniform(110, 170), 130, "shade")
    plain += gen.cyl(lamp + UP * 700, UP, 18, 600, "pole")
    return plain, soft, (rng.uniform(-200, 200), 150.0, rng.uniform(450, 650)), rng.uniform(1900, 2700)


def sofa(gen: ModuleType, rng: np.random.Generator, *, is_single: bool = False) -> tuple[list[SoftBox], float]:
    """Return base, arms, two or three seats and backs and up to two throw cushions, and the half width.

    The back is at y = 500. An armchair (`is_single`) has one seat.
    """
    half_width, depth, seats = rng.uniform(650, 900), rng.uniform(800, 900), int(rng.integers(2, 4))
    if is_single:
        half_width, seats = 0.4 * half_width, 1
    base, seat, back, arm = rng.uniform(220, 280), rng.uniform(140, 190), rng.uniform(340, 430), rng.uniform(140, 220)
    radius, bulge = rng.uniform(10, 30), rng.uniform(0.008, 0.02)

    def upholstered(name: str, centre: Any, size: Any, turn: Array = STRAIGHT) -> SoftBox:
        return soft_box(rng, name, centre, size, turn, radius, bulge)

    # Seats protrude beyond the base and arms beyond both, because no camera can distinguish flush faces.
    front = 500.0 - depth
    soft = [upholstered("base", [0, front + depth / 2, base / 2], [2 * half_width, depth, base])]
    for side in (-1, 1):
        length, height = depth + rng.uniform(60, 110), rng.uniform(560, 640)
        at = [side * (half_width + arm / 2), 500 - length / 2, height / 2]
        soft.append(upholstered(f"arm{side}", at, [arm, length, height]))
    width = 2 * half_width / seats
    for k in range(seats):
        x, deep = -half_width + (k + 0.5) * width, depth - 190
        y = front + deep / 2 - rng.uniform(25, 50)
        soft.append(upholstered(f"seat{k}", [x, y, base + seat / 2], [width - 4, deep, seat]))
        lean = gen.rot([1, 0, 0], -rng.uniform(0.05, 0.25))
        at = [x, 400.0, base + seat + back / 2 - 10]
        soft.append(upholstered(f"back{k}", at, [width - 6, rng.uniform(140, 190), back], lean))
    for k in range(int(rng.integers(0, 3))):
        lean = gen.rot([1, 0, 0], np.pi / 2 - rng.uniform(0.2, 0.5)) @ gen.Rz(rng.uniform(-0.4, 0.4))
        half = np.array([rng.uniform(180, 230), rng.uniform(180, 230), rng.uniform(60, 90)])
        place = np.array([rng.uniform(-0.8, 0.8) * half_width, 220.0, base + seat + half[1] * 0.9])
        box = soft_box(rng, f"throw{k}", place, 2 * half, lean, 0.0, 0.0)
        soft.append(replace(box, is_cushion=True))
    return soft, half_width + arm
