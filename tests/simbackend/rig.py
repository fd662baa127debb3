"""One simulated cell for many tests: the world starts once, every test connects its devices anew."""

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

ROOT = Path(__file__).parents[2]
BENCH = ROOT / "cells" / "bench.toml"


@dataclass(slots=True, kw_only=True, eq=False)
class SimCell:
    """A cell, its clock and the world behind it."""

    cell: Cell
    clock: SimClock = field(default_factory=SimClock)
    shared: Shared = field(default_factory=Shared)

    def connect(self, name: str, **options: Any) -> Any:
        """A fresh device over the common world."""
        section = self.cell.file.devices[name]
        context = Context(name=name, clock=self.clock, cell=self.cell, shared=self.shared)
        return connect(context, section.driver, {**section.options, **options})

    def deadline(self, duration_s: float = 1.0) -> Deadline:
        """A deadline on simulated time."""
        return Deadline.after(self.clock, duration_s)


@contextmanager
def sim_cell(path: Path = BENCH, *, seed: int = 11) -> Iterator[SimCell]:
    """A running cell."""
    cell = SimCell(cell=load_cell(path, seed=seed))
    try:
        yield cell
    finally:
        cell.shared.close()


def injector(device: Device) -> Any:
    """What `Rig.inject` wants, over the simulator's own fault injection."""

    def inject(fault: Fault | None) -> None:
        device.inject_fault(fault)  # every simulated device has it

    return inject
