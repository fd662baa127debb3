"""Interfaces of simulated devices beyond their kind: fault injection, and the true state for the evaluation.

Perception, fusion and manipulation may not import this module; import-linter sees to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, runtime_checkable

from hal.arrays import Array


class Fault(StrEnum):
    """The faults that can be injected into a simulated device."""

    SILENT = "silent"
    STALE = "stale"
    FROZEN = "frozen"
    BIASED = "biased"
    DISCONNECTED = "disconnected"


@runtime_checkable
class FaultInjection(Protocol):
    """The fault-injection interface of simulated devices."""

    def inject_fault(self, fault: Fault | None, *, magnitude: float = 0.0) -> None:
        """Begin a fault, or end it with None."""
        ...


@runtime_checkable
class ShowsValues(Protocol):
    """The interface by which a drill or demonstration lets time pass for the simulated process behind the panel."""

    def show(self, name: str, value: float) -> None:
        """Let an instrument or lamp of the simulated panel show another value from now on.

        Args:
            name: of the panel file.
            value: in the unit of its scale, also beyond its ends; a lamp is lit from 0.5 on.

        Raises:
            InvalidRequest: there is no such object, or it shows no value of a process.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectTruth:
    """The true state of an object of the simulated panel, only for the evaluation of a finished mission."""

    name: str
    value: float | None = None
    state: str | None = None
    text: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueContact:
    """The forces of the arm and its tool on everything that they touched during some time.

    Attributes:
        peak_n: largest force on all things together.
        peaks_n: largest force on each part of the panel by its name; `_plate` is the plate.
        impulse_n_s: integral of the force over the time.
        chatter_n: root mean square of the change of the force from tick to tick, while there was contact.
    """

    peak_n: float = 0.0
    peaks_n: Mapping[str, float] = field(default_factory=dict)
    impulse_n_s: float = 0.0
    chatter_n: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """The simulator's true state, which perception, fusion, manipulation and missions cannot access.

    `initial` holds the states at the time asked for (0 is the beginning of the world), `contact` all forces since then.
    """

    base_from_panel_matrix: Array  # (4, 4)
    objects: tuple[ObjectTruth, ...]
    peak_force_n: float
    sim_time_s: float
    initial: tuple[ObjectTruth, ...] = field(default=())
    contact: TrueContact = field(default_factory=TrueContact)
