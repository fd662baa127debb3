"""Code shared by force/torque sensors: the measuring range as options, and the capabilities derived from it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from hal.devices import ForceTorqueCapabilities
from hal.strict import Strict


class RangeOptions(Strict):
    """Range and noise by the data sheet; by default those of the FT 300-S."""

    force_range_n: Annotated[
        float, Field(gt=0, description="largest force by the data sheet; beyond it a reading is saturated")
    ] = 300.0
    torque_range_nm: Annotated[
        float, Field(gt=0, description="largest torque by the data sheet; beyond it a reading is saturated")
    ] = 30.0
    force_sigma_n: Annotated[float, Field(gt=0, description="noise of the force, one sigma")] = 0.1
    torque_sigma_nm: Annotated[float, Field(gt=0, description="noise of the torque, one sigma")] = 0.005


def capabilities(options: RangeOptions, rate_hz: float) -> ForceTorqueCapabilities:
    """Return the capabilities given by the options."""
    return ForceTorqueCapabilities(
        force_range_n=options.force_range_n,
        torque_range_nm=options.torque_range_nm,
        force_sigma_n=options.force_sigma_n,
        torque_sigma_nm=options.torque_sigma_nm,
        rate_hz=rate_hz,
    )
