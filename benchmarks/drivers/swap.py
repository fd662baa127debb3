"""Exchanges real and simulated devices of a running cell, one kind after another."""

from __future__ import annotations

import time
from pathlib import Path

from benchmarks.drivers.report import CLOCK, line
from hal.clock import Deadline
from hal.config import load_cell
from service.processes.cell import CellRuntime
from service.processes.connection import PREFIX, SWAPPER

CELL = Path(__file__).parents[2] / "cells/wire-ur.toml"
ROUNDS = 3


def part_swap(seconds: float) -> None:  # noqa: ARG001  # a number of swaps, however long they take
    """Measure the seconds from the request to the new device's first sample."""
    cell = load_cell(CELL)
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    swapper = runtime.objects[PREFIX + SWAPPER]
    try:
        for name, behind in cell.file.emulators.items():
            wired, took_s = cell.file.devices[name], {"to simulated": 0.0, "to wired": 0.0}
            for _ in range(ROUNDS):
                for way, block in (("to simulated", behind), ("to wired", wired)):
                    started_s = time.monotonic()
                    swapper.swap(name, block.driver, block.options, deadline=Deadline.after(CLOCK, 10.0))
                    took_s[way] = max(took_s[way], time.monotonic() - started_s)
            measured = ", ".join(f"{way} {took:.2f} s" for way, took in took_s.items())
            line(f"swap {wired.kind}, {wired.driver}, worst of {ROUNDS}", "1 s", measured, max(took_s.values()) <= 1.0)
    finally:
        runtime.close()
