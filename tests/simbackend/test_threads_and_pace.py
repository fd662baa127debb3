"""Tests of many readers beside one that lets time pass, and of a world that keeps pace with the wall clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from hal.clock import Deadline, PacedClock
from hal.config import load_cell
from hal.registry import Context, Shared, connect
from tests.simbackend.rig import BENCH, SimCell


def test_readers_in_other_threads_get_whole_samples_while_time_passes(bench: SimCell) -> None:
    names = ("arm", "wrist_ft", "range_scanner", "panel_lights")
    reads = {"arm": "read_state", "wrist_ft": "read_wrench", "range_scanner": "read_range", "panel_lights": "read_on"}
    faults: list[BaseException] = []
    sequences: dict[str, list[int]] = {name: [] for name in names}
    over = threading.Event()
    ready = threading.Barrier(len(names) + 1)

    def watch(name: str) -> None:
        try:
            read = getattr(bench.connect(name), reads[name])
            ready.wait(120.0)
            sequences[name].append(read(deadline=bench.deadline()).sequence)
            while not over.is_set():
                sequences[name].append(read(deadline=bench.deadline()).sequence)
        except BaseException as fault:
            faults.append(fault)

    threads = [threading.Thread(target=watch, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    ready.wait(120.0)
    began_s = bench.clock.now_s()
    for _ in range(150):
        bench.clock.sleep(0.002)
    over.set()
    for thread in threads:
        thread.join(120.0)
    assert not faults
    assert abs(bench.clock.now_s() - began_s - 0.3) < 1e-9
    for name in names:
        assert sequences[name], name
        assert sequences[name] == sorted(sequences[name]), name


def test_in_mixed_mode_stamps_are_the_clocks_and_sleep_takes_its_time() -> None:
    cell, clock, shared = load_cell(BENCH, seed=4), PacedClock(), Shared()
    try:
        arm = connect(Context(name="arm", clock=clock, cell=cell, shared=shared), "sim:arm", {"model": "t3"})
        began_s, first_s = time.monotonic(), clock.now_s()
        for _ in range(10):
            clock.sleep(0.01)
        assert time.monotonic() - began_s >= 0.1 - 1e-6
        sample = arm.read_state(deadline=Deadline.after(clock, 1.0))
        assert first_s < sample.host_time_s <= clock.now_s()
        assert sample.device_time_s is not None
        # The world is at the time requested by the sleeps or, on a slow machine, up to the wall time, but never beyond.
        assert 0.1 - 1e-9 <= sample.device_time_s <= time.monotonic() - began_s + 0.012
    finally:
        shared.close()


def test_a_world_at_the_walls_pace_catches_up_and_forgets_a_pause() -> None:
    """With a fake wall clock, a sleep that took 60 ms advances the world by 60 ms, and a pause of an hour by 200 ms."""

    class Wall:
        def __init__(self) -> None:
            self.time_s, self.advance = 50.0, lambda _: 0.0

        def now_s(self) -> float:
            return self.time_s

        def attach(self, advance: Callable[[float], float]) -> None:
            self.advance = advance

        def sleep(self, duration_s: float) -> None:
            self.advance(duration_s)
            self.time_s += max(duration_s, 0.060)

    wall, shared = Wall(), Shared()
    try:
        context = Context(name="arm", clock=wall, cell=load_cell(BENCH, seed=4), shared=shared)
        arm = connect(context, "sim:arm", {"model": "t3"})

        def world_s() -> float:
            stamp_s = arm.read_state(deadline=Deadline.after(wall, 1.0)).device_time_s
            assert stamp_s is not None
            return float(stamp_s)

        for _ in range(10):
            wall.sleep(0.002)
        assert world_s() == pytest.approx(9 * 0.060 + 0.002, abs=0.0021)
        before_s = world_s()
        wall.time_s += 3600.0
        wall.sleep(0.002)
        assert world_s() - before_s == pytest.approx(0.2, abs=0.005)
    finally:
        shared.close()


def test_nobody_waits_for_the_world_to_give_an_order(bench: SimCell) -> None:
    """If an emulated link stopped while an image is rendered, its driver would take the device for dead."""
    arm = bench.connect("arm")
    arm.enable(deadline=bench.deadline())
    bench.clock.sleep(0.002)
    here = arm.read_state(deadline=bench.deadline()).value.position_rad
    world: Any = bench.shared.get("world", dict)
    is_busy, may_go_on, is_given = threading.Event(), threading.Event(), threading.Event()

    def keep_busy() -> None:
        is_busy.set()
        may_go_on.wait(60.0)

    def command() -> None:
        arm.command_position(here, deadline=bench.deadline())
        is_given.set()

    world.at(bench.clock.now_s() + 0.002, keep_busy)
    threads = [threading.Thread(target=bench.clock.sleep, args=(0.002,)), threading.Thread(target=command)]
    threads[0].start()
    assert is_busy.wait(60.0)
    threads[1].start()
    assert is_given.wait(30.0)
    may_go_on.set()
    for thread in threads:
        thread.join(60.0)
