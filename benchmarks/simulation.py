"""Measures speed and accuracy of the simulated cell: `python -m benchmarks.simulation [CELL]`.

Prints one line per goal with the pass line beside the measured median. Wall-clock times need an idle machine; the CPU
times beside them are valid on a busy machine, too.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from hal.clock import Deadline, SimClock
from hal.config import load_cell
from hal.registry import Context, Shared, connect

ROOT = Path(__file__).resolve().parents[1]
TICKS = 1000
PICTURES = 15


@dataclass(slots=True, kw_only=True, eq=False)
class Bench:
    """Running cell with all its devices."""

    clock: SimClock
    shared: Shared
    devices: dict[str, Any]
    rate_hz: float

    def deadline(self) -> Deadline:
        """Return a deadline one second from now."""
        return Deadline.after(self.clock, 1.0)


def start(path: Path, **options: dict[str, Any]) -> Bench:
    """Connect every device of a cell file; `options` replace the options of devices by name."""
    cell = load_cell(path)
    clock, shared = SimClock(), Shared()
    devices = {
        name: connect(
            Context(name=name, clock=clock, cell=cell, shared=shared),
            section.driver,
            {**section.options, **options.get(name, {})},
        )
        for name, section in cell.file.devices.items()
    }
    return Bench(clock=clock, shared=shared, devices=devices, rate_hz=cell.file.cell.control_rate_hz)


def real_time_factor(bench: Bench) -> tuple[float, float, float]:
    """Return simulated per wall-clock time with fast sensors read each tick, and CPU us per tick of cell and world."""
    arm = bench.devices["arm"]
    arm.enable(deadline=bench.deadline())
    start_rad = arm.read_state(deadline=bench.deadline()).value.position_rad
    world = psutil.Process().children(recursive=True)[0]
    factors = []
    cell_s, world_s = time.process_time(), sum(world.cpu_times()[:2])
    for i in range(5 * TICKS):
        if i % TICKS == 0:
            began_s = time.perf_counter()
        _tick(bench, start_rad + 0.05 * np.sin(2.0 * np.pi * i / TICKS))
        if i % TICKS == TICKS - 1:
            factors.append(TICKS / bench.rate_hz / (time.perf_counter() - began_s))
    cell_us = 1e6 * (time.process_time() - cell_s) / (5 * TICKS)
    world_us = 1e6 * (sum(world.cpu_times()[:2]) - world_s) / (5 * TICKS)
    return statistics.median(factors), cell_us, world_us


def _tick(bench: Bench, setpoint_rad: np.ndarray) -> None:
    devices, deadline = bench.devices, bench.deadline()
    devices["arm"].command_position(setpoint_rad, deadline=deadline)
    bench.clock.sleep(1.0 / bench.rate_hz)
    devices["arm"].read_state(deadline=deadline)
    devices["wrist_ft"].read_wrench(deadline=deadline)
    devices["finger_touch"].read_contacts(deadline=deadline)
    devices["gripper"].read_state(deadline=deadline)
    devices["proximity_left"].read_distance_m(deadline=deadline)
    devices["proximity_right"].read_distance_m(deadline=deadline)


def picture_ms(bench: Bench, read: Callable[[Deadline], Any]) -> float:
    """Return the median wall-clock time of one image in milliseconds."""
    times = []
    for _ in range(PICTURES):
        bench.clock.sleep(1.0 / bench.rate_hz)
        began_s = time.perf_counter()
        read(bench.deadline())
        times.append(1e3 * (time.perf_counter() - began_s))
    return statistics.median(times)


def sag_rad(bench: Bench) -> float:
    """Return how far the arm sags in two seconds of holding still."""
    arm = bench.devices["arm"]
    arm.enable(deadline=bench.deadline())
    start_rad = arm.read_state(deadline=bench.deadline()).value.position_rad
    bench.clock.sleep(2.0)
    return float(np.abs(arm.read_state(deadline=bench.deadline()).value.position_rad - start_rad).max())


def line(name: str, limit: str, value: str, passed: bool | None) -> None:
    """Print one row of the table; `passed` is None if the row has no pass line."""
    verdict = {True: "pass", False: "FAIL", None: ""}[passed]
    print(f"{name:<46} {limit:>14} {value:>14}  {verdict}")


def main() -> None:
    """Measure and print."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "cells" / "bench.toml"
    began_s = time.perf_counter()
    bench = start(path)
    start_ms = 1e3 * (time.perf_counter() - began_s)
    line("goal", "pass line", "measured", None)
    line("world started, process and all (ms)", "<= 5000", f"{start_ms:.0f}", start_ms <= 5000)
    factor, cell_us, world_us = real_time_factor(bench)
    line("real-time factor, all sensors every tick", ">= 4", f"{factor:.2f}", factor >= 4)
    line("CPU per tick: cell side (us)", "", f"{cell_us:.0f}", None)
    line("CPU per tick: world (us)", "", f"{world_us:.0f}", None)
    sag = sag_rad(bench)
    line("static sag (rad)", "<= 1e-5", f"{sag:.1e}", sag <= 1e-5)
    camera = picture_ms(bench, lambda d: bench.devices["wrist_camera"].read_image(deadline=d))
    line("camera 640x480, anti-aliased, with sensor (ms)", "<= 60", f"{camera:.1f}", camera <= 60)
    small = picture_ms(bench, lambda d: bench.devices["range_scanner"].read_range(deadline=d))
    line("range 128x128 (ms)", "<= 10", f"{small:.1f}", small <= 10)
    bench.shared.close()
    bench = start(path, range_scanner={"width": 256, "height": 256})
    large = picture_ms(bench, lambda d: bench.devices["range_scanner"].read_range(deadline=d))
    line("range 256x256 (ms)", "<= 30", f"{large:.1f}", large <= 30)
    bench.shared.close()


if __name__ == "__main__":
    main()
