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
PAD_STIFFNESS_N_PER_M = 5_000.0  # 20 kN/m raised the lever's peak force from 71 to 114 N in the prototype
PAD_DAMPING_N_S_PER_M = 100.0
FINGER_MASS_KG = 0.04
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
        middle = at(side * FINGER_THICKNESS_M / 2.0, 0.0, -FINGER_LENGTH_M / 2.0)
        lines += link(
            f"finger_{name}",
            inertial(FINGER_MASS_KG, (side * FINGER_THICKNESS_M / 2.0, 0, -FINGER_LENGTH_M / 2.0), (2e-5, 2e-5, 5e-6)),
            shape(middle, box((FINGER_THICKNESS_M, FINGER_WIDTH_M, FINGER_LENGTH_M)), STEEL),
        )
        limits = (-0.002, MAX_WIDTH_M / 2.0 + 0.002)
        lines += joint(
            f"finger_{name}", "prismatic", "gripper", f"finger_{name}", at(0, 0, 0), axis=(side, 0, 0), limits=limits
        )
    return lines
