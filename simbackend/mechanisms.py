"""Resistance of the moving parts of a panel: friction, springs, latches, detents. One joint each.

`drive` is called every tick while the tool is near; otherwise the mechanism is locked, which saves time and changes
nothing. `engine` is a connected PyBullet client; this file never imports PyBullet, so only the world process loads it.
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
BLOCKED_PLAY = 1e-4  # rad or m
SNAP_GAIN_PER_S = 40.0


class Mechanism(Protocol):
    """Part with one joint."""

    body: int

    def lock(self) -> None:
        """Hold the part where it rests."""
        ...

    def drive(self) -> None:
        """Apply one tick of spring, detent or friction."""
        ...

    def place(self) -> float:
        """Return the present joint position, rad or m."""
        ...

    def block(self) -> None:
        """Let the part not give way to any force from now on."""
        ...


@dataclass(slots=True, eq=False)
class Friction:
    """Coulomb friction between end stops: lever, slider, handwheel. The engine's joint limits are the stops."""

    engine: Any
    body: int
    effort: float  # N or N m
    damping: float = 0.0  # N m s/rad or N s/m

    def __post_init__(self) -> None:
        # The engine's stop acts only after the tick in which a part has passed it, so damping limits its speed.
        self.engine.changeDynamics(self.body, JOINT, jointDamping=self.damping)

    def lock(self) -> None:
        """Do nothing: friction holds the part."""
        self.drive()

    def drive(self) -> None:
        """Brake with a velocity motor at zero speed and limited effort, which breaks away within 5 % of that effort."""
        _hold(self.engine, self.body, speed=0.0, effort=self.effort)

    def block(self) -> None:
        """Let the part not give way to any force from now on."""
        _jam(self.engine, self.body)

    def place(self) -> float:
        """Return the joint position."""
        return float(self.engine.getJointState(self.body, JOINT)[0])


@dataclass(slots=True, eq=False)
class Spring:
    """Push button: spring, preload, travel; when `latching`, a push sets a latch and (`releases`) another releases it.

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
    is_blocked: bool = False

    def block(self) -> None:
        """Let the cap not give way to any force from now on."""
        self.is_blocked = True
        _jam(self.engine, self.body)

    def lock(self) -> None:
        """Hold the cap."""
        _hold(self.engine, self.body, speed=0.0, effort=LOCK_EFFORT)

    def free(self) -> None:
        """Release the cap, so that `drive` alone moves it, unless it is blocked."""
        if self.is_blocked:
            return
        _hold(self.engine, self.body, speed=0.0, effort=0.0)

    def drive(self) -> None:
        """Apply the spring force k x + preload outwards and viscous damping, and update the switch."""
        if self.is_blocked:
            return
        x, v = self.engine.getJointState(self.body, JOINT)[:2]
        self._switch(x)
        rest_m = -self.latched_depth_m if self.is_latched else 0.0
        force = -self.spring_n_per_m * (x - rest_m) - DAMPING_N_S_PER_M * v
        if x < rest_m:
            force += self.preload_n
        self.engine.setJointMotorControl2(self.body, JOINT, self.engine.TORQUE_CONTROL, force=force)

    @property
    def latched_depth_m(self) -> float:
        """Return how deep a latched cap stays."""
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
        """Return the joint position."""
        return float(self.engine.getJointState(self.body, JOINT)[0])


@dataclass(slots=True, eq=False)
class Detent:
    """Rests in the nearest of several places: toggle (two) and rotary selector. Turning it away requires `effort`.

    A velocity motor moves to the nearest place, so the breakaway effort is `effort` at every angle and nothing
    oscillates.
    """

    engine: Any
    body: int
    places: tuple[float, ...]
    effort: float
    max_speed: float

    def lock(self) -> None:
        """Continue to move to the nearest place, which holds the part."""
        self.drive()

    def drive(self) -> None:
        """Move to the nearest place."""
        x = self.place()
        error = self.nearest(x) - x
        speed = max(-self.max_speed, min(self.max_speed, SNAP_GAIN_PER_S * error))
        _hold(self.engine, self.body, speed=speed, effort=self.effort)

    def block(self) -> None:
        """Let the part not give way to any force from now on."""
        _jam(self.engine, self.body)

    def nearest(self, x: float) -> float:
        """Return the resting place nearest to `x`."""
        return min(self.places, key=lambda place: abs(place - x))

    def place(self) -> float:
        """Return the joint position."""
        return float(self.engine.getJointState(self.body, JOINT)[0])


def _hold(engine: Any, body: int, *, speed: float, effort: float) -> None:
    """Set a velocity motor with limited effort, which acts as friction, brake or snap depending on speed and effort."""
    engine.setJointMotorControl2(body, JOINT, engine.VELOCITY_CONTROL, targetVelocity=speed, force=effort)


def _jam(engine: Any, body: int) -> None:
    """Put the joint's end stops where it is."""
    place = float(engine.getJointState(body, JOINT)[0])
    engine.changeDynamics(body, JOINT, jointLowerLimit=place - BLOCKED_PLAY, jointUpperLimit=place + BLOCKED_PLAY)
