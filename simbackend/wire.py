"""What crosses the pipe between a cell and its world: one fixed vector of doubles each way per step, no pickle."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import IntEnum

from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.config import Cell

DOF = 6
LIGHTS = 4
MAX_PROXIMITY = 4
DOUBLE = 8  # bytes
PROXIMITY_TICKS = 5  # 100 Hz at the usual tick; fourteen rays would cost a third of every tick
IMAGE_BYTES = 128 * 2**20  # sparse: only what an image touches costs memory


class Op(IntEnum):
    """What a request asks for."""

    CLOSE = 0
    STEP = 1
    RENDER = 2
    TRUTH = 3


class Drive(IntEnum):
    """What a step says to the arm's drives, a bit each; obeyed in this order. (An `IntFlag` costs 3 us a look.)"""

    NONE = 0
    STOP = 1
    ENABLE = 2
    SETPOINT = 4


# Request vector of a step: op, ticks, drive, 6 joints, gripper flag, width, force, speed, lights flag, 4 lights.
REQUEST = 24  # doubles; every request has this length and no frame, so that a step costs one write and one read
JOINTS_AT, GRIPPER_AT, LIGHTS_AT = 3, 9, 13
# Request vector of an image: op, width, height, near, fx, fy, cx, cy, kind, then flange_from_camera row by row (3 x 4).
CAMERA_AT = 9


class Picture(IntEnum):
    """What an image request wants back in shared memory."""

    DEPTH = 0  # float32 metres along the view, NaN where there is nothing
    GREY = 1  # float32 radiance, one channel
    COLOUR = 3  # float32 radiance, RGB


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """All cheap sensors at one tick; true values, in a vector whose parts are named here."""

    vector: Array

    @property
    def tick(self) -> int:
        """Ticks since the world began."""
        return int(self.vector[0])

    @property
    def stamp_s(self) -> float:
        """Simulated seconds."""
        return float(self.vector[1])

    @property
    def is_enabled(self) -> bool:
        """Drives follow set-points."""
        return bool(self.vector[2])

    @property
    def position_rad(self) -> Array:
        """(6,) joints."""
        return self.vector[10:16]

    @property
    def velocity_rad_per_s(self) -> Array:
        """(6,) joint speeds."""
        return self.vector[16:22]

    @property
    def setpoint_rad(self) -> Array:
        """(6,) what the drives aim at."""
        return self.vector[22:28]

    @property
    def wrench(self) -> Array:
        """(6,) of the world on the tool in sensor axes, weight inside, N and N m."""
        return self.vector[28:34]

    @property
    def pad_force_n(self) -> Array:
        """(2,) contact force on the left and the right finger."""
        return self.vector[34:36]

    @property
    def width_m(self) -> float:
        """Opening between the pads."""
        return float(self.vector[36])

    @property
    def is_gripper_moving(self) -> bool:
        """The gripper is on its way."""
        return bool(self.vector[37])

    @property
    def is_holding(self) -> bool:
        """The gripper stopped at its force."""
        return bool(self.vector[38])

    @property
    def lights_on(self) -> Array:
        """(4,) border lights, 1.0 when on."""
        return self.vector[40:44]

    @property
    def distance_m(self) -> Array:
        """(4,) proximity sensors in the order of `WorldConfig.proximity`; NaN when nothing is in range."""
        return self.vector[44:48]

    @property
    def distance_tick(self) -> int:
        """The tick that the distances were measured at."""
        return int(self.vector[48])


SNAPSHOT = 49


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorldConfig:
    """What a world is built from; sent once."""

    cell: Cell
    model: str
    proximity: tuple[RigidTransform, ...]  # flange_from_sensor, true
    proximity_range_m: float
    lookahead_s: float = 0.0  # of the arm's drives


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Emitter:
    """Something that shines: colour (RGB, 0 to 1), place in base axes, radius."""

    colour: tuple[float, float, float]
    position_m: tuple[float, float, float]
    radius_m: float
    is_border_light: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PictureInfo:
    """What comes back beside the pixels."""

    tick: int
    stamp_s: float
    camera_from_base: RigidTransform
    base_from_panel: RigidTransform
    lit: tuple[Emitter, ...]


def read_exactly(descriptor: int, count: int) -> bytes:
    """`count` bytes from a stream.

    Raises:
        EOFError: the other side has gone.
    """
    data = os.read(descriptor, count)
    while len(data) < count:
        more = os.read(descriptor, count - len(data))
        if not more:
            raise EOFError("the other side of the pipe has gone")
        data += more
    return data
