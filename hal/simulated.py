"""What a simulated device offers beyond its kind: faults on request, and the truth for the judge.

Perception, fusion and manipulation may not import this module; import-linter sees to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, runtime_checkable

from hal.arrays import Array


class Fault(StrEnum):
    """What can be injected into a simulated device."""

    SILENT = "silent"
    STALE = "stale"
    FROZEN = "frozen"
    BIASED = "biased"
    DISCONNECTED = "disconnected"


@runtime_checkable
class FaultInjection(Protocol):
    """Extra of simulated devices."""

    def inject_fault(self, fault: Fault | None, *, magnitude: float = 0.0) -> None:
        """Begin a fault, or end it with None."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectTruth:
    """What an object of the simulated panel really shows: only for judging a finished mission."""

    name: str
    value: float | None = None
    state: str | None = None
    text: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """What the simulator knows. Never reachable from perception, fusion, manipulation or missions."""

    base_from_panel_matrix: Array  # (4, 4)
    objects: tuple[ObjectTruth, ...]
    peak_force_n: float
    sim_time_s: float
    initial: tuple[ObjectTruth, ...] = field(default=())  # at the time asked for, 0 is the beginning of the world
