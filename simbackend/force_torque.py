"""`sim:force_torque`: raw wrist sensor with bias, drift, noise, tool weight, resolution and range limit."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from hal.calibration import ToolLoad
from hal.clock import Deadline
from hal.devices import DeviceKind, ForceTorqueCapabilities, Wrench
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from simbackend import kernels
from simbackend.client import Frame
from simbackend.device import VALID, SimDevice, SimOptions, parse

FORCE_RANGE_N, TORQUE_RANGE_NM = 300.0, 30.0
FORCE_DIGIT_N, TORQUE_DIGIT_NM = 0.02, 0.0005
DRIFT_PERIOD_S = 180.0
FORCES = np.repeat([1.0, 0.0], 3)  # an injected bias acts on the force only


class ForceTorqueOptions(SimOptions):
    """Noise (one sigma) and slow drift (amplitude) of force and torque."""

    force_sigma_n: Annotated[float, Field(ge=0, le=50, description="noise of the force, one sigma")] = 0.15
    torque_sigma_nm: Annotated[float, Field(ge=0, le=5, description="noise of the torque, one sigma")] = 0.004
    force_drift_n: Annotated[float, Field(ge=0, le=50, description="amplitude of the slow drift of the force")] = 0.15
    torque_drift_nm: Annotated[float, Field(ge=0, le=5, description="amplitude of the slow drift of the torque")] = (
        0.004
    )


class SimForceTorque(SimDevice[Wrench]):
    """Wrench that the world exerts on the tool, including tool weight and sensor bias."""

    def __init__(self, context: Context, options: ForceTorqueOptions) -> None:
        super().__init__(context, DeviceKind.FORCE_TORQUE, options)
        kernels.warm_up()
        self._options = options
        draws = self._world.draws
        record = (
            self._world.cell.calibration_of(context.name).load
            if context.name in self._world.cell.file.devices
            else None
        )
        nominal = (
            record.load() if record is not None else ToolLoad(mass_kg=0.0, centre_of_mass_m=(0, 0, 0), bias=(0,) * 6)
        )
        self._bias = np.asarray(draws.load(context.name, nominal).bias)
        self._noise = draws.noise(context.name, 6)
        self._phase = draws.stream(f"drift/{context.name}").uniform(0.0, 2.0 * math.pi, 6)
        self._sigma = np.repeat([options.force_sigma_n, options.torque_sigma_nm], 3)
        self._drift = np.repeat([options.force_drift_n, options.torque_drift_nm], 3)
        self._digit = np.repeat([FORCE_DIGIT_N, TORQUE_DIGIT_NM], 3)
        self._range = np.repeat([FORCE_RANGE_N, TORQUE_RANGE_NM], 3)

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return range, noise and rate."""
        return ForceTorqueCapabilities(
            force_range_n=FORCE_RANGE_N,
            torque_range_nm=TORQUE_RANGE_NM,
            force_sigma_n=self._options.force_sigma_n,
            torque_sigma_nm=self._options.torque_sigma_nm,
            rate_hz=self._world.rate_hz,
        )

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        return self._sample(deadline)

    def _measure(self, frame: Frame, bias: float) -> tuple[Wrench, Quality, Cause]:
        snapshot = frame.snapshot
        angle_rad = 2.0 * math.pi * snapshot.stamp_s / DRIFT_PERIOD_S
        noise = self._noise.at(snapshot.tick)
        raw = kernels.raw_wrench(
            snapshot.wrench, self._bias + bias * FORCES, self._drift, self._phase, angle_rad, noise, self._sigma,
            self._digit,
        )  # fmt: skip
        if (np.abs(raw) <= self._range).all():
            return Wrench(force_n=raw[:3], torque_nm=raw[3:]), *VALID
        raw = np.clip(raw, -self._range, self._range)
        return Wrench(force_n=raw[:3], torque_nm=raw[3:]), Quality.DEGRADED, Cause.SATURATED


@takes(ForceTorqueOptions)
def connect(context: Context, options: dict[str, Any]) -> SimForceTorque:
    """Entry point `sim:force_torque`."""
    return SimForceTorque(context, parse(options, ForceTorqueOptions, context))
