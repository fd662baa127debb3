"""Tool below the flange: force/torque sensor, parallel gripper, two slim fingers.

Grip frame: origin between the finger tips at the tip end, z forward along the fingers, x the closing direction. Each
finger is 7 mm thick (x), 12 mm wide (y) and 75 mm long: closed, they make a 14 x 12 mm fingertip for buttons and
toggles; open, each fits between objects 20 mm apart.
"""

from __future__ import annotations

from scipy.spatial.transform import RigidTransform

from simbackend.urdf import at, box, cylinder, inertial, joint, link, shape

MAX_WIDTH_M = 0.080
MAX_FORCE_N = 120.0
MAX_SPEED_M_PER_S = 0.15
FINGER_THICKNESS_M = 0.007
FINGER_WIDTH_M = 0.012
FINGER_LENGTH_M = 0.075
FINGER_MASS_KG = 0.04
ROOT_MASS_KG = 0.002  # of each of the two parts between gripper and finger
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}  # along which a finger moves
GIVE_LIMITS_M = (-0.02, 0.02)
OPENING_LIMITS_M = (GIVE_LIMITS_M[0], MAX_WIDTH_M / 2.0 + GIVE_LIMITS_M[1])  # of one finger, outwards
SENSOR_MASS_KG = 0.01  # the part of the sensor below its measuring element
DARK = (0.18, 0.18, 0.20)
STEEL = (0.55, 0.57, 0.60)


def tool_urdf(*, flange_from_sensor: RigidTransform, flange_from_grip: RigidTransform, load_kg: float) -> list[str]:
    """Return the URDF lines of the tool.

    `load_kg` is all mass below the sensor, and the gripper's body gets the remainder.
    """
    sensor_from_grip = flange_from_sensor.inv() * flange_from_grip
    body_kg = load_kg - SENSOR_MASS_KG - 2.0 * FINGER_MASS_KG
    # The sensor's own centre of mass lies at its origin, because PyBullet reports the reaction there.
    lines = link(
        "sensor",
        inertial(SENSOR_MASS_KG, (0, 0, 0), (1e-5,) * 3),
        shape(at(0, 0, 0.018), cylinder(0.036, 0.036), STEEL),
    )
    lines += joint("sensor", "fixed", "flange", "sensor", flange_from_sensor)
    lines += link(
        "gripper",
        inertial(body_kg, (0, 0, -0.13), (1.2e-3, 1.2e-3, 6e-4)),
        shape(at(0, 0, -0.125), box((0.095, 0.06, 0.09)), DARK),
    )
    lines += joint("gripper", "fixed", "sensor", "gripper", sensor_from_grip)
    for name, side in (("left", -1.0), ("right", 1.0)):
        parent = "gripper"
        for letter, axis in AXES.items():
            child = f"finger_{name}" if letter == "z" else f"root_{letter}_{name}"
            limits, turned = (OPENING_LIMITS_M, side) if letter == "x" else (GIVE_LIMITS_M, 1.0)
            along = (turned * axis[0], axis[1], axis[2])
            lines += _slide(f"give_{letter}_{name}", parent, child, axis=along, limits=limits)
            lines += link(child, *([_lump(ROOT_MASS_KG)] if letter != "z" else _finger(side)))
            parent = child
    return lines


def _finger(side: float) -> list[list[str]]:
    """Return mass and shape of a finger."""
    middle = (side * FINGER_THICKNESS_M / 2.0, 0.0, -FINGER_LENGTH_M / 2.0)
    geometry = box((FINGER_THICKNESS_M, FINGER_WIDTH_M, FINGER_LENGTH_M))
    return [
        inertial(FINGER_MASS_KG - 2.0 * ROOT_MASS_KG, middle, (2e-5, 2e-5, 5e-6)),
        shape(at(*middle), geometry, STEEL),
    ]


def _slide(
    name: str, parent: str, child: str, *, axis: tuple[float, float, float], limits: tuple[float, float]
) -> list[str]:
    return joint(name, "prismatic", parent, child, at(0, 0, 0), axis=axis, limits=limits)


def _lump(mass_kg: float) -> list[str]:
    return inertial(mass_kg, (0, 0, -FINGER_LENGTH_M / 2.0), (1e-6, 1e-6, 1e-6))
