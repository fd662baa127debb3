"""URDF text from primitives. One tag per line, because PyBullet's parser truncates lines of more than about 1 kB."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

Colour = tuple[float, float, float]


def origin(pose: RigidTransform) -> str:
    """Return the `<origin>` tag of a pose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # at gimbal lock any of the equivalent solutions will do
        rpy = pose.rotation.as_euler("xyz")
    return f'<origin xyz="{_numbers(pose.translation)}" rpy="{_numbers(rpy)}"/>'


def inertial(mass_kg: float, centre_m: Sequence[float], inertia_kg_m2: Sequence[float]) -> list[str]:
    """Return mass, centre and principal inertia of a link."""
    xx, yy, zz = inertia_kg_m2
    return [
        "<inertial>",
        f'<origin xyz="{_numbers(centre_m)}"/>',
        f'<mass value="{float(mass_kg)!r}"/>',
        f'<inertia ixx="{float(xx)!r}" iyy="{float(yy)!r}" izz="{float(zz)!r}" ixy="0" ixz="0" iyz="0"/>',
        "</inertial>",
    ]


def box(size_m: Sequence[float]) -> str:
    """Return a box centred at the origin."""
    return f'<box size="{_numbers(size_m)}"/>'


def cylinder(radius_m: float, length_m: float) -> str:
    """Return a cylinder along z centred at the origin."""
    return f'<cylinder radius="{float(radius_m)!r}" length="{float(length_m)!r}"/>'


def sphere(radius_m: float) -> str:
    """Return a sphere."""
    return f'<sphere radius="{float(radius_m)!r}"/>'


def shape(
    pose: RigidTransform, geometry: str, colour: Colour, *, visual: bool = True, collision: bool = True
) -> list[str]:
    """Return the same geometry as visual and collision shape."""
    lines: list[str] = []
    if visual:
        name = "c" + "_".join(f"{c:.3f}" for c in colour)
        paint = [f'<material name="{name}">', f'<color rgba="{_numbers(colour)} 1"/>', "</material>"]
        lines += ["<visual>", origin(pose), "<geometry>", geometry, "</geometry>", *paint, "</visual>"]
    if collision:
        lines += ["<collision>", origin(pose), "<geometry>", geometry, "</geometry>", "</collision>"]
    return lines


def joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    parent_from_joint: RigidTransform,
    *,
    axis: Sequence[float] = (0, 0, 1),
    limits: tuple[float, float] = (-9.0, 9.0),
) -> list[str]:
    """Return a joint tag; limits in rad or m."""
    return [
        f'<joint name="{name}" type="{kind}">',
        f'<parent link="{parent}"/>',
        f'<child link="{child}"/>',
        origin(parent_from_joint),
        f'<axis xyz="{_numbers(axis)}"/>',
        f'<limit lower="{float(limits[0])!r}" upper="{float(limits[1])!r}" effort="10000" velocity="100"/>',
        "</joint>",
    ]


def link(name: str, *parts: list[str]) -> list[str]:
    """Return a link tag around its parts."""
    return [f'<link name="{name}">', *[line for part in parts for line in part], "</link>"]


def at(x_m: float, y_m: float, z_m: float) -> RigidTransform:
    """Return a pure translation."""
    return RigidTransform.from_translation([x_m, y_m, z_m])


def along(start_m: Sequence[float], end_m: Sequence[float]) -> tuple[RigidTransform, float]:
    """Return a frame midway between two points with z from the first to the second, and their distance."""
    a, b = np.asarray(start_m, float), np.asarray(end_m, float)
    length = float(np.linalg.norm(b - a))
    if length == 0.0:
        return RigidTransform.from_translation(a), 0.0
    turn, _ = Rotation.align_vectors([(b - a) / length], [[0.0, 0.0, 1.0]])
    return RigidTransform.from_components((a + b) / 2.0, turn), length


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(v)) for v in values)
