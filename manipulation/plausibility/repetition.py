"""Finds sensors that repeat one reading under new time stamps, which is impossible for a working sensor with noise."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.devices import ForceTorque
from manipulation.plausibility.finding import Finding, Symptom

# A contact force grows by 6 N in this time; sensor noise has never repeated for so long.
FROZEN_S, FROZEN_TICKS, FROZEN_PERIODS = 0.1, 10, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDigest:
    """A frame of a camera or range scanner: when it was taken (cell clock, s) and a digest of its array.

    `is_blank`: whether all of it has one value, as of a saturated picture, in which noise does not show.
    """

    stamp_s: float
    digest: bytes
    is_blank: bool = False

    @classmethod
    def of(cls, array: NDArray[np.generic], *, stamp_s: float) -> FrameDigest:
        """Return the frame of an array."""
        digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).digest()
        return cls(stamp_s=stamp_s, digest=digest, is_blank=bool((array == array.flat[0]).all()))


def repeated_frame(device: str, before: FrameDigest | None, newest: FrameDigest) -> Finding | None:
    """Find a device that sent the same frame again under another time stamp."""
    if before is None or before.digest != newest.digest or before.stamp_s == newest.stamp_s or newest.is_blank:
        return None
    return Finding(
        device=device,
        symptom=Symptom.FROZEN,
        what=f"{device} repeats the same frame under a new stamp",
        remedy=f"{device} is frozen: power-cycle it; nothing was measured with the old frame",
    )


class RepeatedWrench:
    """Finds a force/torque sensor that repeats one reading, with which no guard would ever see a contact.

    A sensor without specified noise is not checked, because it may repeat readings.
    """

    def __init__(self, sensor: ForceTorque | None) -> None:
        self._name = "" if sensor is None else sensor.name
        capabilities = None if sensor is None else sensor.capabilities()
        self._is_noisy = capabilities is not None and capabilities.force_sigma_n > 0.0
        period_s = 0.0 if capabilities is None else 1.0 / capabilities.rate_hz
        self._longest_s = max(FROZEN_S, FROZEN_PERIODS * period_s)
        self._kept = b""
        self._since_s = 0.0
        self._ticks = 0

    def note(self, raw_wrench: Array, *, stamp_s: float) -> Finding | None:
        """Check the newest reading (6,); there is a finding if all six numbers have been the same for too long."""
        if not self._is_noisy:
            return None
        newest = raw_wrench.tobytes()
        if newest != self._kept:
            self._kept, self._since_s, self._ticks = newest, stamp_s, 0
            return None
        self._ticks += 1
        lasted_s = stamp_s - self._since_s
        if lasted_s < self._longest_s or self._ticks < FROZEN_TICKS:
            return None
        return Finding(
            device=self._name,
            symptom=Symptom.FROZEN,
            what=f"{self._name} repeats the same reading under new stamps for {lasted_s:.2f} s",
            remedy="switch the sensor off and on, and check its cable",
        )
