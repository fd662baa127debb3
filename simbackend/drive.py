"""Drives of arm and gripper: the behaviour between set-points and motors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hal.arrays import Array
from hal.devices import ArmCapabilities
from simbackend.tool_model import MAX_WIDTH_M

MOVING_RAD_PER_S = 0.05
START_WIDTH_M = 0.040


class ArmDrive:
    """Follows set-points, brakes at the acceleration limit on `stop`, and stops when set-points cease during a motion.

    Args:
        lookahead_s: set-points that come over a link arrive in bunches and gaps, so the drives smooth them with a
            critically damped follower, x'' = w^2 (goal - x) - 2 w x' with w = 2 / lookahead, which lags a steady
            stream by `lookahead_s`. With 0 each set-point is for the next tick.
    """

    def __init__(
        self, capabilities: ArmCapabilities, position_rad: Array, dt_s: float, *, lookahead_s: float = 0.0
    ) -> None:
        self._limit = np.asarray(capabilities.acceleration_rad_per_s2)
        self._watchdog_s = capabilities.watchdog_s or np.inf
        self._dt_s = dt_s
        self._omega = 2.0 / lookahead_s if lookahead_s > 0.0 else 0.0
        self._age_s = 0.0
        self._fresh = False
        self._is_braking = False
        self.setpoint = np.asarray(position_rad, float).copy()
        self._goal = self.setpoint
        self.speed = np.zeros_like(self.setpoint)
        self._last_speed = self.speed
        self.is_enabled = False

    def aim(self, position_rad: Array) -> None:
        """Set the set-point for the next tick; ignored while disabled."""
        if not self.is_enabled:
            return
        self._fresh = True
        self._goal = position_rad.copy()
        if self._omega:
            return
        self._last_speed = (position_rad - self.setpoint) / self._dt_s
        self.setpoint = self._goal
        self.speed = self._last_speed

    def enable(self, measured_rad: list[float]) -> None:
        """Start to follow, with the measured position as set-point."""
        self.setpoint = np.asarray(measured_rad, float).copy()
        self._goal = self.setpoint
        self.speed = np.zeros_like(self.setpoint)
        self.is_enabled, self._is_braking, self._age_s = True, False, 0.0
        self._last_speed = self.speed

    def stop(self) -> None:
        """Brake and reject set-points."""
        self.is_enabled, self._is_braking = False, True

    def tick(self) -> None:
        """Advance by one tick."""
        if self._is_braking:
            self._brake()
            return
        if self._omega:
            self._follow()
        if self._fresh:
            self._fresh, self._age_s = False, 0.0
            return
        if self._age_s == 0.0 and not self._omega:
            self.speed = np.zeros_like(self.setpoint)
        self._age_s += self._dt_s
        if self.is_enabled and self._age_s > self._watchdog_s and np.abs(self._last_speed).max() > MOVING_RAD_PER_S:
            self.is_enabled = False

    def _follow(self) -> None:
        """Advance the follower by one tick; its damping is implicit, so it is stable for any lookahead."""
        w, dt_s = self._omega, self._dt_s
        pull = self.speed + w * w * dt_s * (self._goal - self.setpoint)
        self.speed = pull / (1.0 + 2.0 * w * dt_s + w * w * dt_s * dt_s)
        self.setpoint = self.setpoint + self.speed * dt_s
        self._last_speed = self.speed

    def _brake(self) -> None:
        step = self._limit * self._dt_s
        self.speed = np.sign(self.speed) * np.maximum(np.abs(self.speed) - step, 0.0)
        self.setpoint = self.setpoint + self.speed * self._dt_s
        self._is_braking = bool(self.speed.any())


@dataclass(slots=True, eq=False)
class GripperDrive:
    """Drive of two pads on one screw: both move equally, stop at the set force, and stay locked there."""

    dt_s: float
    width_m: float = START_WIDTH_M
    speed: float = 0.0
    is_moving: bool = False
    is_holding: bool = False
    _target_m: float = field(default=START_WIDTH_M)
    _speed_m_per_s: float = 0.05
    _force_n: float = 20.0

    def aim(self, width_m: float, force_n: float, speed_m_per_s: float) -> None:
        """Start to move towards a width."""
        self._target_m = min(max(width_m, 0.0), MAX_WIDTH_M)
        self._force_n, self._speed_m_per_s = force_n, speed_m_per_s
        self.is_moving, self.is_holding = True, False

    def tick(self, pad_force_n: tuple[float, ...]) -> None:
        """Move the screw by one tick."""
        self.speed = 0.0
        if not self.is_moving:
            return
        gap_m = self._target_m - self.width_m
        # One screw drives both pads, so it is loaded by the mean of their forces.
        if gap_m < 0.0 and sum(pad_force_n) / len(pad_force_n) >= self._force_n:
            self.is_moving, self.is_holding = False, True
            return
        step_m = self._speed_m_per_s * self.dt_s
        if abs(gap_m) <= step_m:
            self.width_m, self.is_moving = self._target_m, False
            return
        self.speed = self._speed_m_per_s if gap_m > 0.0 else -self._speed_m_per_s
        self.width_m += self.speed * self.dt_s
