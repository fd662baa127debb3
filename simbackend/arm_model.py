"""The simulated arms as Denavit-Hartenberg tables, and the URDF generated from them for PyBullet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.devices import ArmCapabilities, DhLink
from hal.geometry import identity, product, transform_rpy
from simbackend.tool_model import tool_urdf
from simbackend.urdf import Colour, along, cylinder, inertial, joint, link, shape, sphere


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArmModel:
    """Everything the world needs to build one arm; `mass_kg` is given per link and `torque_nm` per joint."""

    capabilities: ArmCapabilities
    mass_kg: tuple[float, ...]
    torque_nm: tuple[float, ...]


def t3() -> ArmModel:
    """Return an arm similar to a T3-726: 1.04 m from shoulder to flange, spherical wrist, tip at most 1.0 m/s.

    The link lengths are not those of the real arm.
    """
    quarter = math.pi / 2.0
    links = (
        DhLink(d_m=0.70, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.0, a_m=0.46, alpha_rad=0.0),
        DhLink(d_m=0.0, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.46, a_m=0.0, alpha_rad=-quarter),
        DhLink(d_m=0.0, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.12, a_m=0.0, alpha_rad=0.0),
    )
    limits_rad = [(-2.97, 2.97), (-0.80, 2.80), (-2.60, 1.45), (-3.40, 3.40), (-2.30, 2.30), (-5.00, 5.00)]
    return ArmModel(
        capabilities=_capabilities(
            "t3",
            links,
            limits_rad,
            velocity=(1.6, 1.6, 1.8, 3.2, 3.2, 4.0),
            radius=(0.09, 0.06, 0.06, 0.05, 0.045, 0.04),
        ),
        mass_kg=(20.0, 12.0, 3.0, 7.0, 1.5, 0.8),
        torque_nm=(600.0, 600.0, 350.0, 90.0, 80.0, 50.0),
    )


def ur10e() -> ArmModel:
    """Return an arm similar to a UR10e: its published DH table with rounded masses and radii."""
    quarter = math.pi / 2.0
    links = (
        DhLink(d_m=0.1807, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.0, a_m=-0.6127, alpha_rad=0.0),
        DhLink(d_m=0.0, a_m=-0.57155, alpha_rad=0.0),
        DhLink(d_m=0.17415, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.11985, a_m=0.0, alpha_rad=-quarter),
        DhLink(d_m=0.11655, a_m=0.0, alpha_rad=0.0),
    )
    return ArmModel(
        capabilities=_capabilities(
            "ur10e",
            links,
            [(-6.28, 6.28), (-6.28, 6.28), (-3.14, 3.14), *[(-6.28, 6.28)] * 3],
            velocity=(2.0, 2.0, 3.0, 3.0, 3.0, 3.0),
            radius=(0.08, 0.065, 0.055, 0.05, 0.045, 0.045),
        ),
        mass_kg=(7.4, 13.0, 4.0, 2.0, 2.0, 0.6),
        torque_nm=(600.0, 600.0, 350.0, 90.0, 80.0, 80.0),
    )


def panda() -> ArmModel:
    """Return an arm similar to a Franka Panda: seven joints by its published DH table, with rounded masses and radii.

    The table is converted from the modified to the standard convention. The motors are stronger than the real arm's.
    """
    quarter = math.pi / 2.0
    links = (
        DhLink(d_m=0.333, a_m=0.0, alpha_rad=-quarter),
        DhLink(d_m=0.0, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.316, a_m=0.0825, alpha_rad=quarter),
        DhLink(d_m=0.0, a_m=-0.0825, alpha_rad=-quarter),
        DhLink(d_m=0.384, a_m=0.0, alpha_rad=quarter),
        DhLink(d_m=0.0, a_m=0.088, alpha_rad=quarter),
        DhLink(d_m=0.107, a_m=0.0, alpha_rad=0.0),
    )
    wide, last = (-2.8973, 2.8973), (-0.0175, 3.7525)
    return ArmModel(
        capabilities=_capabilities(
            "panda",
            links,
            [wide, (-1.7628, 1.7628), wide, (-3.0718, -0.0698), wide, last, wide],
            velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
            acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
            radius=(0.08, 0.07, 0.065, 0.065, 0.055, 0.05, 0.045),
        ),
        mass_kg=(5.0, 3.0, 3.5, 2.5, 3.0, 1.5, 0.7),
        torque_nm=(400.0, 400.0, 250.0, 250.0, 80.0, 80.0, 80.0),
    )


MODELS = {"t3": t3, "ur10e": ur10e, "panda": panda}


def _capabilities(
    model: str,
    links: tuple[DhLink, ...],
    limits_rad: list[tuple[float, float]],
    *,
    velocity: tuple[float, ...],
    radius: tuple[float, ...],
    acceleration: tuple[float, ...] = (8.0, 8.0, 8.0, 20.0, 20.0, 20.0),
) -> ArmCapabilities:
    return ArmCapabilities(
        model=model,
        links=links,
        lower_rad=tuple(low for low, _ in limits_rad),
        upper_rad=tuple(high for _, high in limits_rad),
        velocity_rad_per_s=velocity,
        acceleration_rad_per_s2=acceleration,
        tip_speed_m_per_s=1.0,
        command_rate_hz=500.0,
        link_radius_m=radius,
        watchdog_s=0.1,
    )


def base_from_flange(links: tuple[DhLink, ...], position_rad: np.ndarray) -> RigidTransform:
    """Return base_from_flange as the product of Rz(q + offset) Tz(d) Tx(a) Rx(alpha) over the joints."""
    pose = identity()
    for dh, q in zip(links, position_rad, strict=True):
        turn = transform_rpy((0.0, 0.0, 0.0), (0.0, 0.0, q + dh.offset_rad))
        pose = product(pose, product(turn, link_from_next(dh)))
    return pose


def link_from_next(dh: DhLink) -> RigidTransform:
    """Return the fixed part of a standard DH link: Tz(d) Tx(a) Rx(alpha)."""
    return transform_rpy((dh.a_m, 0.0, dh.d_m), (dh.alpha_rad, 0.0, 0.0))


def arm_urdf(
    model: ArmModel, *, flange_from_sensor: RigidTransform, flange_from_grip: RigidTransform, load_kg: float
) -> str:
    """Return the URDF of arm, force/torque sensor and gripper, built from primitives.

    Link i turns about z at the end of link i - 1: its frame is DH frame i - 1 turned by q_i. The flange is fixed to
    the last link.
    """
    caps = model.capabilities
    lines = ['<robot name="arm">', *link("base", inertial(10.0, (0, 0, 0), (1.0, 1.0, 1.0)))]
    parent, parent_from_joint = "base", RigidTransform.identity()
    for i, dh in enumerate(caps.links):
        turn = transform_rpy((0.0, 0.0, 0.0), (0.0, 0.0, dh.offset_rad))
        name = f"link{i + 1}"
        lines += _link(
            name, model.mass_kg[i], (dh.a_m, 0.0, dh.d_m), caps.link_radius_m[i], PAINT[i % 2], is_foot=i == 0
        )
        lines += joint(name, "continuous", parent, name, parent_from_joint * turn)
        parent, parent_from_joint = name, link_from_next(dh)
    lines += link("flange", inertial(0.02, (0, 0, 0), (1e-5, 1e-5, 1e-5)))
    lines += joint("flange", "fixed", parent, "flange", parent_from_joint)
    lines += tool_urdf(flange_from_sensor=flange_from_sensor, flange_from_grip=flange_from_grip, load_kg=load_kg)
    return "\n".join([*lines, "</robot>"])


PAINT: tuple[Colour, Colour] = ((0.85, 0.45, 0.10), (0.30, 0.32, 0.35))


def _link(
    name: str, mass_kg: float, end_m: tuple[float, float, float], radius_m: float, paint: Colour, *, is_foot: bool
) -> list[str]:
    """Return a capsule from this joint to the next: a cylinder and a sphere, the shape that `link_radius_m` describes.

    The foot stands in the floor, so it has no collision shape: a permanent contact would cost time in every tick.
    """
    middle, length_m = along((0.0, 0.0, 0.0), end_m)
    across = mass_kg * (3.0 * radius_m**2 + length_m**2) / 12.0 + 1e-4
    lengthwise = mass_kg * radius_m**2 / 2.0 + 1e-4
    # Inertia is given in the link's own axes; a link lies along x or along z.
    inertia = (lengthwise, across, across) if abs(end_m[0]) > abs(end_m[2]) else (across, across, lengthwise)
    parts = [
        inertial(mass_kg, tuple(middle.translation), inertia),
        shape(RigidTransform.identity(), sphere(radius_m), paint, collision=not is_foot),
    ]
    if length_m > 0.0:
        parts.append(shape(middle, cylinder(radius_m, length_m), paint, collision=not is_foot))
    return link(name, *parts)
