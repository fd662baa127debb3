"""Many readers beside one that lets time pass; and a world that keeps the wall's pace."""

from __future__ import annotations

import threading
import time

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


def test_in_mixed_mode_stamps_are_the_walls_and_sleep_takes_its_time() -> None:
    cell, clock, shared = load_cell(BENCH, seed=4), PacedClock(), Shared()
    try:
        arm = connect(Context(name="arm", clock=clock, cell=cell, shared=shared), "sim:arm", {"model": "t3"})
        began_s = time.monotonic()
        for _ in range(10):
            clock.sleep(0.01)
        assert time.monotonic() - began_s >= 0.1 - 1e-6
        sample = arm.read_state(deadline=Deadline.after(clock, 1.0))
        assert began_s < sample.host_time_s <= time.monotonic()
        assert sample.device_time_s is not None
        assert abs(sample.device_time_s - 0.1) < 1e-9
    finally:
        shared.close()
