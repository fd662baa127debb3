"""Data format of the pipe between a cell and its world: one fixed vector of doubles each way per step, no pickle."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import IntEnum

from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.config import Cell

MOST_JOINTS = 7  # room in the vectors; an arm with fewer leaves the rest at 0
LIGHTS = 4
MAX_PROXIMITY = 4
DOUBLE = 8  # bytes
PROXIMITY_TICKS = 5  # 100 Hz at the usual tick; fourteen rays per tick would cost a third of its time
IMAGE_BYTES = 128 * 2**20  # sparse: only pages that an image touches use memory


class Op(IntEnum):
    """Type of a request."""

    CLOSE = 0
    STEP = 1
    RENDER = 2
    TRUTH = 3
    EVENT = 4
    SHOW = 5


class DriveCommand(IntEnum):
    """Commands to the arm's drives in a step, one bit each, obeyed in this order.

    (An `IntFlag` costs 3 us per access.)
    """

    NONE = 0
    STOP = 1
    ENABLE = 2
    SETPOINT = 4


# Request vector of a step: op, ticks, drive, 7 joints, gripper flag, width, force, speed, lights flag, 4 lights.
REQUEST = 24  # doubles; all requests have this length without framing, so a step costs one write and one read
JOINTS_AT, GRIPPER_AT, LIGHTS_AT = 3, 10, 14
# Request vector of an image: op, width, height, near, fx, fy, cx, cy, kind, then flange_from_camera row by row (3 x 4).
CAMERA_AT = 9


class PictureType(IntEnum):
    """Type of data that an image request returns in shared memory."""

    DEPTH = 0  # float32 metres along the view, NaN where there is no surface
    GREY = 1  # float32 radiance, one channel
    COLOUR = 3  # float32 radiance, RGB


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """All inexpensive sensors at one tick: true values, in a vector whose parts are named here."""

    vector: Array

    @property
    def tick(self) -> int:
        """Return the ticks since the world began."""
        return int(self.vector[0])

    @property
    def stamp_s(self) -> float:
        """Return the simulated time in seconds."""
        return float(self.vector[1])

    @property
    def is_enabled(self) -> bool:
        """Return whether the drives follow set-points."""
        return bool(self.vector[2])

    @property
    def tip_m(self) -> Array:
        """Return the (3,) place of the finger tips in the base frame, at most four ticks old."""
        return self.vector[3:6]

    @property
    def joints(self) -> int:
        """Return the number of the arm's joints, n."""
        return int(self.vector[9])

    @property
    def position_rad(self) -> Array:
        """Return the (n,) joint positions."""
        return self.vector[10 : 10 + self.joints]

    @property
    def velocity_rad_per_s(self) -> Array:
        """Return the (n,) joint speeds."""
        return self.vector[17 : 17 + self.joints]

    @property
    def setpoint_rad(self) -> Array:
        """Return the (n,) set-points of the drives."""
        return self.vector[24 : 24 + self.joints]

    @property
    def wrench(self) -> Array:
        """Return the (6,) wrench of the world on the tool in sensor axes, including the weight, N and N m."""
        return self.vector[31:37]

    @property
    def pad_force_n(self) -> Array:
        """Return the (2,) contact forces on the left and the right finger."""
        return self.vector[37:39]

    @property
    def width_m(self) -> float:
        """Return the opening between the pads."""
        return float(self.vector[39])

    @property
    def is_gripper_moving(self) -> bool:
        """Return whether the gripper is moving."""
        return bool(self.vector[40])

    @property
    def is_holding(self) -> bool:
        """Return whether the gripper has stopped at its set force."""
        return bool(self.vector[41])

    @property
    def lights_on(self) -> Array:
        """Return the (4,) border lights, 1.0 when on."""
        return self.vector[43:47]

    @property
    def distance_m(self) -> Array:
        """Return (4,) proximity distances in the order of `WorldConfig.proximity`; NaN when nothing is in range."""
        return self.vector[47:51]

    @property
    def distance_tick(self) -> int:
        """Return the tick at which the distances were measured."""
        return int(self.vector[51])


SNAPSHOT = 52


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorldConfig:
    """Configuration of a world; sent once."""

    cell: Cell
    model: str
    proximity: tuple[RigidTransform, ...]  # flange_from_sensor, true
    proximity_range_m: float
    lookahead_s: float = 0.0  # of the arm's drives


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Emitter:
    """Light source: colour (RGB, 0 to 1), position in base axes, radius."""

    colour: tuple[float, float, float]
    position_m: tuple[float, float, float]
    radius_m: float
    is_border_light: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PictureInfo:
    """Description that is returned with the pixels."""

    tick: int
    stamp_s: float
    camera_from_base: RigidTransform
    base_from_panel: RigidTransform
    lit: tuple[Emitter, ...]


def read_exactly(descriptor: int, count: int) -> bytes:
    """Return `count` bytes from a stream.

    Raises:
        EOFError: the other side has closed it.
    """
    data = os.read(descriptor, count)
    while len(data) < count:
        more = os.read(descriptor, count - len(data))
        if not more:
            raise EOFError("the process at the other end of the pipe has ended")
        data += more
    return data
