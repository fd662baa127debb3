"""How the moving parts of a panel resist a finger: friction, springs, latches, detents. One joint each.

A mechanism is `drive`n every tick while the tool is near; far away it is locked, which saves time and changes nothing.
`engine` is a connected PyBullet client; this file never imports the module, so that only the world process loads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from hal.panel import LATCHED_SHARE

JOINT = 0
DAMPING_N_S_PER_M = 4.0
TURN_DAMPING_NM_S_PER_RAD = 0.05
SLIDE_DAMPING_N_S_PER_M = 5.0
LOCK_EFFORT = 200.0
SNAP_GAIN_PER_S = 40.0


class Mechanism(Protocol):
    """A part with one joint."""

    body: int

    def lock(self) -> None:
        """Hold the part where it rests."""
        ...

    def drive(self) -> None:
        """Apply one tick of spring, detent or friction."""
        ...

    def place(self) -> float:
        """Present joint position, rad or m."""
        ...


@dataclass(slots=True, eq=False)
class Friction:
    """Coulomb friction between end stops: lever, slider, handwheel. The engine's joint limits are the stops."""

    engine: Any
    body: int
    effort: float  # N or N m
    damping: float = 0.0  # N m s/rad or N s/m

    def __post_init__(self) -> None:
        # The engine's stop catches a part only after the tick in which it passed: damping keeps it from racing.
        self.engine.changeDynamics(self.body, JOINT, jointDamping=self.damping)

    def lock(self) -> None:
        """Friction is its own lock."""
        self.drive()

    def drive(self) -> None:
        """A velocity motor at rest with limited effort breaks away within 5 % of that effort."""
        _hold(self.engine, self.body, speed=0.0, effort=self.effort)

    def place(self) -> float:
        """Joint position."""
        return float(self.engine.getJointState(self.body, JOINT)[0])


@dataclass(slots=True, eq=False)
class Spring:
    """Push button: spring, preload, travel; when `latching`, a push sets a latch and (`releases`) another frees it.

    The joint runs from 0 (out) to -travel (in).
    """

    engine: Any
    body: int
    travel_m: float
    spring_n_per_m: float
    preload_n: float
    latching: bool
    releases: bool
    is_latched: bool = False
    is_in: bool = False
    presses: int = 0

    def lock(self) -> None:
        """Hold the cap."""
        _hold(self.engine, self.body, speed=0.0, effort=LOCK_EFFORT)

    def free(self) -> None:
        """Let go of the cap, so that `drive` alone moves it."""
        _hold(self.engine, self.body, speed=0.0, effort=0.0)

    def drive(self) -> None:
        """Spring force k x + preload outwards, viscous damping, and the switch."""
        x, v = self.engine.getJointState(self.body, JOINT)[:2]
        self._switch(x)
        rest_m = -self.latched_depth_m if self.is_latched else 0.0
        force = -self.spring_n_per_m * (x - rest_m) - DAMPING_N_S_PER_M * v
        if x < rest_m:
            force += self.preload_n
        self.engine.setJointMotorControl2(self.body, JOINT, self.engine.TORQUE_CONTROL, force=force)

    @property
    def latched_depth_m(self) -> float:
        """How far a latched cap stays in."""
        return LATCHED_SHARE * self.travel_m

    def _switch(self, x: float) -> None:
        # Closes at 80 % of the travel and opens at 70 %: a switch without hysteresis would chatter.
        if not self.is_in and x <= -0.8 * self.travel_m:
            self.is_in = True
            self.presses += 1
            if self.latching:
                self.is_latched = not self.is_latched if self.releases else True
        elif self.is_in and x >= -0.7 * self.travel_m:
            self.is_in = False

    def place(self) -> float:
        """Joint position."""
        return float(self.engine.getJointState(self.body, JOINT)[0])


@dataclass(slots=True, eq=False)
class Detent:
    """Rests in the nearest of several places: toggle (two) and rotary selector. Turning it away costs `effort`.

    A velocity motor aims at the nearest place, so the breakaway effort is `effort` at every angle, and nothing rings.
    """

    engine: Any
    body: int
    places: tuple[float, ...]
    effort: float
    max_speed: float

    def lock(self) -> None:
        """A detent is its own lock: go on aiming at the nearest place."""
        self.drive()

    def drive(self) -> None:
        """Aim at the nearest place."""
        x = self.place()
        error = self.nearest(x) - x
        speed = max(-self.max_speed, min(self.max_speed, SNAP_GAIN_PER_S * error))
        _hold(self.engine, self.body, speed=speed, effort=self.effort)

    def nearest(self, x: float) -> float:
        """The resting place next to `x`."""
        return min(self.places, key=lambda place: abs(place - x))

    def place(self) -> float:
        """Joint position."""
        return float(self.engine.getJointState(self.body, JOINT)[0])


def _hold(engine: Any, body: int, *, speed: float, effort: float) -> None:
    """A velocity motor with limited effort: friction, brake or snap, as its speed and effort say."""
    engine.setJointMotorControl2(body, JOINT, engine.VELOCITY_CONTROL, targetVelocity=speed, force=effort)
