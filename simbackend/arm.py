"""`sim:arm`: the simulated arm."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from hal.arrays import Array
from hal.clock import Deadline
from hal.devices import ArmCapabilities, DeviceKind, JointState
from hal.errors import InvalidRequest, MotionRefused
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from hal.simulated import Truth
from simbackend import kernels
from simbackend.arm_model import MODELS
from simbackend.client import Frame
from simbackend.device import VALID, SimDevice, SimOptions, parse

DIGITS = 6  # encoders resolve a microradian
MOVING_RAD_PER_S = 0.002


class ArmOptions(SimOptions):
    """`model`: which arm. `lookahead_s`: of its drives, for an arm behind a wire (see `ArmDrive`)."""

    model: Annotated[Literal["t3", "ur10e", "panda"], Field(description="arm that is simulated")] = "t3"
    lookahead_s: Annotated[
        float,
        Field(
            ge=0, le=0.2, description="time over which the drives smooth set-points, for an arm behind an emulated wire"
        ),
    ] = 0.0

    def known_arm(self) -> ArmCapabilities:
        """Return kinematics and limits of the model."""
        return MODELS[self.model]().capabilities


class SimArm(SimDevice[JointState]):
    """Position-controlled arm; set-points are sent with the next step of the clock."""

    def __init__(self, context: Context, options: ArmOptions) -> None:
        super().__init__(context, DeviceKind.ARM, options)
        kernels.warm_up()
        self._capabilities = replace(MODELS[options.model]().capabilities, command_rate_hz=self._world.rate_hz)
        self._lower = np.asarray(self._capabilities.lower_rad)
        self._upper = np.asarray(self._capabilities.upper_rad)
        # A set-point one tick late covers two ticks of travel, so a single missed tick must not clip it.
        # Behind an emulated link the drives lag the set-points by their lookahead, and set-points arrive in bunches.
        ticks_s = 2.0 / self._world.rate_hz + 2.0 * options.lookahead_s
        self._stride = ticks_s * np.asarray(self._capabilities.velocity_rad_per_s)

    def capabilities(self) -> ArmCapabilities:
        """Return kinematics and limits."""
        return self._capabilities

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the newest measured joint state."""
        return self._sample(deadline)

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Store the set-point of the next tick, clipped to joint limits and twice the speed limit.

        Raises:
            InvalidRequest: wrong shape or not finite.
            MotionRefused: drives are off.
        """
        self._check(deadline)
        wanted = np.asarray(position_rad, float)
        if wanted.shape != self._lower.shape or not math.isfinite(wanted @ wanted):
            raise InvalidRequest(
                f"{self._name}: a set-point must be {len(self._lower)} finite joint angles",
                hint="check the planner that sent it",
                device=self._name,
            )
        if not self._world.is_enabled:
            raise MotionRefused(f"{self._name}: the drives are off", hint="call enable first", device=self._name)
        last = self._world.frame.snapshot.setpoint_rad
        sent: Array = kernels.reachable(wanted, last, self._stride, self._lower, self._upper)
        self._world.aim_arm(sent)
        return sent

    def enable(self, *, deadline: Deadline) -> None:
        """Enable the drives from the next tick on."""
        self._check(deadline)
        self._world.enable()

    def stop(self, *, deadline: Deadline) -> None:
        """Brake from the next tick on."""
        self._check(deadline)
        self._world.stop()

    def truth(self, initial_s: float = 0.0) -> Truth:
        """Return the true state of the world; only the judge of a finished mission and tests may call this."""
        return self._world.truth(initial_s)

    def show(self, name: str, value: float) -> None:
        """Let an instrument or lamp of the panel show another value; see `hal.simulated.ShowsValues`."""
        self._world.show(name, value)

    def _measure(self, frame: Frame, bias: float) -> tuple[JointState, Quality, Cause]:
        snapshot = frame.snapshot
        velocity = snapshot.velocity_rad_per_s
        state = JointState(
            position_rad=snapshot.position_rad.round(DIGITS) + bias,
            velocity_rad_per_s=velocity.copy(),
            is_enabled=snapshot.is_enabled,
            is_moving=max(map(abs, velocity.tolist())) > MOVING_RAD_PER_S,
        )
        return state, *VALID


@takes(ArmOptions)
def connect(context: Context, options: dict[str, Any]) -> SimArm:
    """Entry point `sim:arm`."""
    return SimArm(context, parse(options, ArmOptions, context))
