"""Compiled computations for devices that are used in every control tick; numpy calls would cost ten times more."""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.arrays import Array
from hal.jit import compiled


@compiled
def reachable(wanted: Array, last: Array, stride: Array, lower: Array, upper: Array) -> Any:
    """Return the set-point nearest to `wanted` that lies within the range and at most `stride` from the `last` one.

    A drive that starts beyond a limit may come back but may not go further out.
    """
    out = np.empty_like(wanted)
    for k in range(wanted.shape[0]):
        low = max(last[k] - stride[k], lower[k])
        high = min(last[k] + stride[k], upper[k])
        out[k] = min(max(wanted[k], min(low, high)), max(low, high))
    return out


@compiled
def raw_wrench(
    true: Array, bias: Array, drift: Array, phase_rad: Array, angle_rad: float, noise: Array, sigma: Array, digit: Array
) -> Any:
    """Return the (6,) sensor reading true + bias + drift sin(angle + phase) + sigma noise, rounded to its resolution."""
    out = np.empty(6)
    for k in range(6):
        raw = true[k] + bias[k] + drift[k] * np.sin(angle_rad + phase_rad[k]) + sigma[k] * noise[k]
        out[k] = np.rint(raw / digit[k]) * digit[k]
    return out


def warm_up() -> None:
    """Compile the kernels or load them; the first compilation on a machine takes half a minute."""
    six = np.ones(6)
    frozen = np.frombuffer(six.tobytes())  # snapshots are read-only views, which the compiler treats as a separate type
    reachable(six, frozen, six, six, six)
    raw_wrench(frozen, six, six, six, 1.0, six, six, six)
