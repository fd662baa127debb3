"""Simulated cell for many tests: the world is started once, and every test connects its own devices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.clock import Deadline, SimClock
from hal.config import Cell, load_cell
from hal.devices import Device
from hal.registry import Context, Shared, connect
from hal.simulated import Fault
from hal.simulated_events import EventSection

ROOT = Path(__file__).parents[2]
BENCH = ROOT / "cells" / "bench.toml"


@dataclass(slots=True, kw_only=True, eq=False)
class SimCell:
    """Cell with its clock and its simulated world."""

    cell: Cell
    clock: SimClock = field(default_factory=SimClock)
    shared: Shared = field(default_factory=Shared)

    def connect(self, name: str, **options: Any) -> Any:
        """Return a new device of the common world."""
        section = self.cell.file.devices[name]
        context = Context(name=name, clock=self.clock, cell=self.cell, shared=self.shared)
        return connect(context, section.driver, {**section.options, **options})

    def deadline(self, duration_s: float = 1.0) -> Deadline:
        """Return a deadline in simulated time."""
        return Deadline.after(self.clock, duration_s)


@contextmanager
def sim_cell(path: Path = BENCH, *, seed: int = 11, events: tuple[EventSection, ...] = ()) -> Iterator[SimCell]:
    """Yield a running cell, in whose world these events happen."""
    loaded = load_cell(path, seed=seed)
    simulation = loaded.file.simulation.model_copy(update={"events": events})
    file = loaded.file.model_copy(update={"simulation": simulation})
    cell = SimCell(cell=loaded.model_copy(update={"file": file}))
    try:
        yield cell
    finally:
        cell.shared.close()


def injector(device: Device) -> Any:
    """Return a function for `Rig.inject` that uses the simulator's fault injection."""

    def inject(fault: Fault | None) -> None:
        device.inject_fault(fault)  # every simulated device has this method

    return inject
