"""Random numbers of a sweep, each from a stream of its own that is named after what it is for."""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """Return a generator that depends on the seed and the name only."""
    return np.random.default_rng([seed, zlib.crc32(f"sweep/{name}".encode())])


def uniform(seed: int, name: str, low: float, high: float) -> float:
    """Return a number between two others, in tenths of a thousandth."""
    return round(float(stream(seed, name).uniform(low, high)), 4)


def pick(seed: int, name: str, items: tuple[Any, ...]) -> Any:
    """Return one of the items."""
    return items[int(stream(seed, name).integers(len(items)))]


def radians(degrees: float) -> float:
    """Return an angle in radians, as a panel file has it."""
    return round(math.radians(degrees), 6)
