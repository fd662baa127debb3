"""Compiled small steps of the devices that every control tick talks to; a numpy call each would cost ten times more."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from hal.arrays import Array


@njit(cache=True)
def reachable(wanted: Array, last: Array, stride: Array, lower: Array, upper: Array) -> Any:
    """The set-point nearest to `wanted` that lies within range and no further than `stride` from the `last` one.

    A drive that woke beyond a limit may come back but go no further out.
    """
    out = np.empty_like(wanted)
    for k in range(wanted.shape[0]):
        low = max(last[k] - stride[k], lower[k])
        high = min(last[k] + stride[k], upper[k])
        out[k] = min(max(wanted[k], min(low, high)), max(low, high))
    return out


@njit(cache=True)
def raw_wrench(
    true: Array, bias: Array, drift: Array, phase_rad: Array, angle_rad: float, noise: Array, sigma: Array, digit: Array
) -> Any:
    """(6,) what a wrist sensor says: true + bias + drift sin(angle + phase) + sigma noise, to its last digit."""
    out = np.empty(6)
    for k in range(6):
        raw = true[k] + bias[k] + drift[k] * np.sin(angle_rad + phase_rad[k]) + sigma[k] * noise[k]
        out[k] = np.rint(raw / digit[k]) * digit[k]
    return out


def warm_up() -> None:
    """Compile or load; takes half a minute once on a machine."""
    six = np.ones(6)
    frozen = np.frombuffer(six.tobytes())  # snapshots are read-only views, a type of their own to the compiler
    reachable(six, frozen, six, six, six)
    raw_wrench(frozen, six, six, six, 1.0, six, six, six)
