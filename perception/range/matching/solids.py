"""Ray casting of component models: bounded primitives in the object's frame (compiled).

A solid is a table with one row per surface. Its columns are:

    0       form: DISC, RECTANGLE, CYLINDER, CONE, SPHERE, ELLIPSOID or TORUS
    1-3     reference point: centre of a face, cylinder, sphere or torus, or the apex of a cone
    4-6     unit axis or normal
    7-9     unit direction of a rectangle's first side
    10, 11  radius and half length (cylinder), half sides (rectangle), tangent of the half angle (cone),
            radius (disc, sphere), radius of the centre line and of the tube (torus)
    10-12   radii along the object's axes (ellipsoid)
    13, 14  least and greatest z of the part of a sphere or cone that exists
    15      1 if the surface belongs to the sliding part

Only the nearest hit along a ray counts, so one surface of a solid can hide another.
"""

# ruff: noqa: PLR0912 - compiled loops take plain arrays, and one branch per form is clearest.
from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices
from hal.jit import as_numpy_scalar, compiled
from perception.range.matching.models import ComponentModel, Form, ModelSurface, MotionKind

DISC, RECTANGLE, CYLINDER, CONE, SPHERE, ELLIPSOID, TORUS = range(7)
WIDTH = 16
MOVES = 15
TRACE_STEPS = 24  # most steps of `_ring` along a ray
TRACE_END_M = 1e-5  # distance from the torus at which the tracing ends
FREE_LENGTH = 4.0  # half length, in radii, of a cylinder whose length the model does not give
MARGIN_PX = as_numpy_scalar(1)  # around the bounding box of a surface


def solid_of(model: ComponentModel) -> Array:
    """Return the table (S, 16) with one row per surface of the model, in the model's order."""
    return np.stack([_row(s) for s in model.surfaces])


def boxes_of(model: ComponentModel, *, with_travel: bool = False) -> Array:
    """Return the corners (S, 2, 3) of a bounding box of each surface in the object's frame, enlarged by its tolerance.

    `with_travel`: the box covers every state of the sliding part; without it the part is at state 0.
    """
    rows = solid_of(model)
    out = np.empty((len(rows), 2, 3))
    for k, (surface, row) in enumerate(zip(model.surfaces, rows, strict=True)):
        reach = _reach(row)
        low, high = row[1:4] - reach, row[1:4] + reach
        low[2], high[2] = max(low[2], row[13]), min(high[2], row[14])
        shifts = _shifts(model, surface) if with_travel else [np.zeros(3)]
        out[k, 0] = np.min([low + s for s in shifts], axis=0) - surface.tolerance_m
        out[k, 1] = np.max([high + s for s in shifts], axis=0) + surface.tolerance_m
    return out


def _shifts(model: ComponentModel, surface: ModelSurface) -> list[Array]:
    """Return the displacements (3,) of a surface at both ends of its travel; a single zero if it does not slide."""
    if model.motion != MotionKind.SLIDE or not surface.moves:
        return [np.zeros(3)]
    return [model.motion_axis * model.low, model.motion_axis * model.high]


def _reach(row: Array) -> Array:
    """Return the half extent (3,) of a surface about its reference point, along the object's axes."""
    form, axis = int(row[0]), row[4:7]
    across = np.sqrt(np.maximum(1.0 - axis**2, 0.0))
    if form == RECTANGLE:
        other = np.cross(axis, row[7:10])
        return np.asarray(np.abs(row[7:10]) * row[10] + np.abs(other) * row[11])
    if form == CYLINDER:
        return np.asarray(np.abs(axis) * row[11] + across * row[10])
    if form == CONE:
        far = float(np.max(np.abs(row[13:15] - row[3])))
        return np.asarray(np.abs(axis) * far + across * far * row[10])
    if form == ELLIPSOID:
        return row[10:13].copy()
    if form == TORUS:
        return np.asarray(across * row[10] + row[11])
    return np.asarray((across if form == DISC else 1.0) * row[10])


def _row(s: ModelSurface) -> Array:
    """Return the table row (16,) of a surface."""
    row = np.zeros(WIDTH)
    row[1:4], row[4:7], row[7:10] = s.point_m, s.direction, s.along
    row[13], row[14] = s.between_m
    row[MOVES] = float(s.moves)
    if s.type == Form.PLANE:
        row[0] = RECTANGLE if s.sides_m is not None else DISC
        row[10:12] = (0.5 * s.sides_m[0], 0.5 * s.sides_m[1]) if s.sides_m is not None else (s.size_m, 0.0)
    elif s.type == Form.CYLINDER:
        row[0] = CYLINDER
        row[10:12] = s.size_m, 0.5 * s.length_m if s.length_m > 0 else FREE_LENGTH * s.size_m
    elif s.type == Form.CONE:
        row[0], row[10] = CONE, np.tan(s.half_angle_rad)
    elif s.type == Form.SPHERE:
        row[0], row[10] = SPHERE, s.size_m
    elif s.type == Form.ELLIPSOID:
        row[0], row[10:13] = ELLIPSOID, s.radii_m
    else:
        row[0], row[10], row[11] = TORUS, s.size_m, s.tube_m
    return row


@compiled
def hit(row: Array, grow: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    """Return the smallest t at which the ray o + t d hits a surface, given by its row and enlarged by `grow` metres.

    Infinite if the ray misses.
    """
    form = int(row[0])
    wx, wy, wz = ox - row[1], oy - row[2], oz - row[3]
    ax, ay, az = row[4], row[5], row[6]
    if form <= RECTANGLE:
        facing = ax * dx + ay * dy + az * dz
        if abs(facing) < 1e-9:
            return np.inf
        t = -(ax * wx + ay * wy + az * wz) / facing
        px, py, pz = wx + t * dx, wy + t * dy, wz + t * dz
        if form == DISC:
            r = row[10] + grow
            return t if px * px + py * py + pz * pz <= r * r else np.inf
        a = px * row[7] + py * row[8] + pz * row[9]
        b = np.sqrt(max(px * px + py * py + pz * pz - a * a, 0.0))
        return t if abs(a) <= row[10] + grow and b <= row[11] + grow else np.inf
    if form == TORUS:
        return _ring(row[10] + grow, row[11], ax, ay, az, wx, wy, wz, dx, dy, dz)
    if form == ELLIPSOID:
        u, v, w = 1.0 / row[10], 1.0 / row[11], 1.0 / row[12]
        wx, wy, wz, dx, dy, dz = wx * u, wy * v, wz * w, dx * u, dy * v, dz * w
        A, B = dx * dx + dy * dy + dz * dz, dx * wx + dy * wy + dz * wz
        disc = B * B - A * (wx * wx + wy * wy + wz * wz - 1.0)
        return (-B - np.sqrt(disc)) / A if disc >= 0.0 else np.inf
    A, B, C = dx * dx + dy * dy + dz * dz, dx * wx + dy * wy + dz * wz, wx * wx + wy * wy + wz * wz
    if form == SPHERE:
        r = row[10] + grow
        C -= r * r
    else:
        if form == CONE:
            # Enlarging a cone by g moves its apex back along the axis by g / tan(angle).
            back = grow / row[10]
            wx, wy, wz = wx + back * ax, wy + back * ay, wz + back * az
            B, C = dx * wx + dy * wy + dz * wz, wx * wx + wy * wy + wz * wz
        da, wa = dx * ax + dy * ay + dz * az, wx * ax + wy * ay + wz * az
        k = 1.0 + row[10] * row[10] if form == CONE else 1.0
        r = 0.0 if form == CONE else row[10] + grow
        A, B, C = A - k * da * da, B - k * da * wa, C - k * wa * wa - r * r
    disc = B * B - A * C
    if disc < 0.0 or A == 0.0:
        return np.inf
    root = np.sqrt(disc)
    near, far = (-B - root) / A, (-B + root) / A
    if near > far:
        near, far = far, near
    for t in (near, far):
        z = oz + t * dz
        if form == CYLINDER:
            if abs((wx + t * dx) * ax + (wy + t * dy) * ay + (wz + t * dz) * az) <= row[11]:
                return float(t)
        elif row[13] <= z <= row[14] and (
            form == SPHERE or (wx + t * dx) * ax + (wy + t * dy) * ay + (wz + t * dz) * az > 0.0
        ):
            return float(t)
    return np.inf


@compiled
def _ring(
    R: float, r: float, ax: float, ay: float, az: float, wx: float, wy: float, wz: float, dx: float, dy: float,
    dz: float,
) -> float:  # fmt: skip
    """Intersect a ray with a torus by sphere tracing (Hart, The Visual Computer 12, 1996); infinite on a miss.

    R, r: radii of the centre line and of the tube; a: unit axis; w, d: origin relative to the centre, and direction, of
    the ray.
    """
    A, B = dx * dx + dy * dy + dz * dz, dx * wx + dy * wy + dz * wz
    disc = B * B - A * (wx * wx + wy * wy + wz * wz - (R + r) * (R + r))
    if disc < 0.0:
        return np.inf
    root = np.sqrt(disc)
    t, end = (-B - root) / A, (-B + root) / A
    # The tube lies between two parallel planes, so the search is limited to the ray's path between them.
    da, wa = dx * ax + dy * ay + dz * az, wx * ax + wy * ay + wz * az
    if abs(da) > 1e-6:
        first, last = (-r - wa) / da, (r - wa) / da
        t, end = max(t, min(first, last)), min(end, max(first, last))
    elif abs(wa) > r:
        return np.inf
    step = 1.0 / np.sqrt(A)
    for _ in range(TRACE_STEPS):
        if t > end:
            return np.inf
        px, py, pz = wx + t * dx, wy + t * dy, wz + t * dz
        h = px * ax + py * ay + pz * az
        q = np.sqrt(max(px * px + py * py + pz * pz - h * h, 0.0)) - R
        away = np.sqrt(q * q + h * h) - r
        if away < TRACE_END_M:
            return float(t)
        t += away * step
    return np.inf


@compiled
def window_of(
    box: Array, shift: Array, R: Array, p: Array, sen: Array, margin: int, limit: Indices, window: Indices,
) -> None:  # fmt: skip
    """Fill `window` (u0, v0, u1, v1) with the pixels that a box (2, 3) of the object's frame covers.

    R, p: sensor_from_object. `shift` (3,) displaces the box, `margin` pixels are added on each side, and the window is
    clipped to `limit`.
    """
    u0, v0, u1, v1 = 1e9, 1e9, -1e9, -1e9
    for corner in range(8):
        x = box[corner & 1, 0] + shift[0]
        y = box[(corner >> 1) & 1, 1] + shift[1]
        z = box[corner >> 2, 2] + shift[2]
        X = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + p[0]
        Y = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + p[1]
        if sen[0] > 0.0:
            Z = max(R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + p[2], 1e-3)
            X, Y = X / Z, Y / Z
        u, v = X * sen[1] + sen[3], Y * sen[2] + sen[4]
        u0, v0, u1, v1 = min(u0, u), min(v0, v), max(u1, u), max(v1, v)
    window[0] = int(min(max(np.floor(u0) - margin, limit[0]), limit[2]))
    window[1] = int(min(max(np.floor(v0) - margin, limit[1]), limit[3]))
    window[2] = int(min(max(np.ceil(u1) + margin + 1, window[0]), limit[2]))
    window[3] = int(min(max(np.ceil(v1) + margin + 1, window[1]), limit[3]))


@compiled
def render(
    rows: Array, boxes: Array, grow: Array, shift: Array, R: Array, p: Array, sen: Array, window: Indices, stride: int,
    depth: Array, index: Indices,
) -> None:  # fmt: skip
    """Fill `depth` (infinite where no surface is hit) and `index` (row number or -1) over a window of the image.

    Args:
        rows, grow: the solid, and the length (m) added to the size of each row.
        boxes: (S, 2, 3) corners of the bounding box of each row, object frame.
        shift: (3,) displacement of the sliding part, object frame, m.
        R, p: sensor_from_object.
        sen: `RangeSensorModel.packed()`.
        window: u0, v0, u1, v1 (exclusive); every `stride`-th pixel is drawn, packed densely into the outputs.
    """
    h, w = (window[3] - window[1] + stride - 1) // stride, (window[2] - window[0] + stride - 1) // stride
    depth[:h, :w] = np.inf
    index[:h, :w] = -1
    part, away = np.empty(4, np.int64), np.empty(3)
    for s in range(rows.shape[0]):
        for a in range(3):
            away[a] = shift[a] * rows[s, MOVES]
        window_of(boxes[s], away, R, p, sen, MARGIN_PX, window, part)
        for j in range((part[1] - window[1] + stride - 1) // stride, (part[3] - window[1] + stride - 1) // stride):
            y = (window[1] + j * stride - sen[4]) / sen[2]
            for i in range((part[0] - window[0] + stride - 1) // stride, (part[2] - window[0] + stride - 1) // stride):
                x = (window[0] + i * stride - sen[3]) / sen[1]
                if sen[0] > 0.0:
                    ex, ey, ez, fx, fy = -p[0], -p[1], -p[2], x, y
                else:
                    ex, ey, ez, fx, fy = x - p[0], y - p[1], -p[2], 0.0, 0.0
                ox = R[0, 0] * ex + R[1, 0] * ey + R[2, 0] * ez - away[0]
                oy = R[0, 1] * ex + R[1, 1] * ey + R[2, 1] * ez - away[1]
                oz = R[0, 2] * ex + R[1, 2] * ey + R[2, 2] * ez - away[2]
                dx = R[0, 0] * fx + R[1, 0] * fy + R[2, 0]
                dy = R[0, 1] * fx + R[1, 1] * fy + R[2, 1]
                dz = R[0, 2] * fx + R[1, 2] * fy + R[2, 2]
                t = hit(rows[s], grow[s], ox, oy, oz, dx, dy, dz)
                if t < depth[j, i]:
                    depth[j, i] = t
                    index[j, i] = s
