"""ROS 2 messages as rosbridge sends them in JSON: reading those of sensors, and writing commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.arrays import Array

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
POSITIONS = "std_msgs/msg/Float64MultiArray"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
GRIPPER_COMMAND = "control_msgs/action/GripperCommand"
NANO = 1e-9
LONGEST_DURATION_S = 3600.0


class BadMessage(ValueError):
    """A message lacks a field, or a field has the wrong type."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Joints:
    """Joints of one JointState message, in the order asked for; a value that the message lacks is NaN."""

    stamp_s: float
    position: Array
    velocity: Array
    effort: Array


def stamp_s(message: dict[str, Any]) -> float:
    """Return the time stamp of a message's header, in seconds since 1970; 0 when its sender does not stamp.

    Raises:
        BadMessage: the message has no stamp.
    """
    stamp = _part(message, "header", "stamp")
    return float(_whole(stamp, "sec") + NANO * _whole(stamp, "nanosec"))


def joints_of(message: dict[str, Any], names: Sequence[str]) -> Joints | None:
    """Return the joints called `names` from a JointState message; None when it is about other joints only.

    Raises:
        BadMessage: it holds only some of these joints, or is malformed.
    """
    given = message.get("name")
    if not isinstance(given, list):
        raise BadMessage("a joint state has no list of names")
    missing = [name for name in names if name not in given]
    if len(missing) == len(names):
        return None
    if missing:
        raise BadMessage(f"a joint state lacks {missing[0]!r}")
    places = [given.index(name) for name in names]
    position, velocity, effort = (
        _numbers(message, key, len(given))[places] for key in ("position", "velocity", "effort")
    )
    if not np.all(np.isfinite(position)):
        raise BadMessage("a joint state has a position that is not finite")
    return Joints(stamp_s=stamp_s(message), position=position, velocity=velocity, effort=effort)


def wrench_of(message: dict[str, Any]) -> tuple[float, Array, Array]:
    """Return stamp, force (3,) and torque (3,) of a WrenchStamped message; not finite where its sender has no value.

    Raises:
        BadMessage: it is malformed.
    """
    force, torque = (
        np.array([_number(_part(message, "wrench", part), axis) for axis in "xyz"]) for part in ("force", "torque")
    )
    return stamp_s(message), force, torque


def trajectory(
    names: Sequence[str], position_rad: Array, after_s: float, *, velocity_rad_per_s: Array | None = None
) -> dict[str, Any]:
    """Return a JointTrajectory with one point, which is to be reached `after_s` after the message arrives.

    The stamp of zero means that the trajectory begins at once, so the clocks of the two machines need not agree.
    """
    point = {
        "positions": [float(q) for q in position_rad],
        "velocities": [] if velocity_rad_per_s is None else [float(v) for v in velocity_rad_per_s],
        "accelerations": [],
        "effort": [],
        "time_from_start": duration(after_s),
    }
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": list(names), "points": [point]}


def positions(position: Array) -> dict[str, Any]:
    """Return a Float64MultiArray with the positions."""
    return {"layout": {"dim": [], "data_offset": 0}, "data": [float(q) for q in position]}


def duration(duration_s: float) -> dict[str, int]:
    """Return a Duration."""
    nanoseconds = round(min(max(duration_s, 0.0), LONGEST_DURATION_S) / NANO)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _part(message: Any, *keys: str) -> Any:
    for key in keys:
        if not isinstance(message, dict) or key not in message:
            raise BadMessage(f"a message lacks {'.'.join(keys)}")
        message = message[key]
    return message


def _number(message: Any, key: str) -> float:
    """Return a number; JSON has no NaN, so rosbridge sends null."""
    value = _part(message, key)
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadMessage(f"{key} is no number but {value!r}")
    return float(value)


def _whole(message: Any, key: str) -> int:
    value = _part(message, key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadMessage(f"{key} is no whole number but {value!r}")
    return value


def _numbers(message: dict[str, Any], key: str, count: int) -> Array:
    """Return the list under `key`; NaN for each of `count` when it is empty, as ROS allows."""
    values = _part(message, key)
    if not isinstance(values, list) or len(values) not in (0, count):
        raise BadMessage(f"{key} of a joint state is no list of {count} numbers")
    if not values:
        return np.full(count, math.nan)
    return np.array([_number({key: value}, key) for value in values])
