"""Measures how range analysis scales: with tiles (the paper's Fig. 9), and with batches of scans on many workers.

    python -m benchmarks.range_scaling [--folder RECORDINGS]

Tiles: every pixel step of the chain is timed tile by tile; the critical path is the slowest tile of each step, plus one
barrier per step, plus log2(P) rounds of seam merges, plus the steps without tiles (region fits). Two communication
costs are assumed: shared memory (10 us per barrier) and messages (50 us, and 10 Gbit/s for the halo rows).

Batches: tasks are timed on one and on two workers, and a discrete-event simulation with tasks of these lengths must end
when the real run ended. The simulation is then extended to 1024 workers, with stragglers and one lost worker.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.range_filter_pass import geometry_of
from benchmarks.tiled_components import _merge_seam, _scan, merge_rounds
from hal.arrays import Array
from hal.workers import workers_of
from perception.range.analysis import analyse
from perception.range.batch import IMAGES_A_TASK, analyse_files, recordings_in, tasks_of
from perception.range.fitting.surfaces import SIZE
from perception.range.noise import estimate_noise
from perception.range.segmentation.blocks import mean_blocks
from perception.range.segmentation.boundary_pixels import contested_pixels
from perception.range.segmentation.pixel_assignment import assign_pixels, reassign_pixels
from perception.range.segmentation.tangents import tangent_planes
from perception.range.sensor import PinholeSensor
from perception.range.tiles import tile_rows
from perception.range.warm import warm_up

SHARED_BARRIER_S = 10e-6
MESSAGE_S = 50e-6
BITS_PER_S = 10e9
HALO_ROWS = 3
TILES = (1, 2, 4, 8, 16, 32)
WORKERS = (1, 2, 4, 16, 64, 256, 1024)


@dataclass(frozen=True, slots=True, kw_only=True)
class Path1:
    """Critical path of one image for a number of tiles, in seconds: with shared memory and with messages."""

    tiles: int
    shared_s: float
    message_s: float


def main() -> None:
    """Run the command line; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="recordings for the batch part; made up when not given")
    parser.add_argument("--images", type=int, default=240, help="made-up recordings")
    arguments = parser.parse_args()
    warm_up()
    for side in (256, 2048):
        print_tiles(side)
    if arguments.folder is not None:
        print_batch(arguments.folder)
        return
    with tempfile.TemporaryDirectory() as folder:
        make_recordings(Path(folder), arguments.images)
        print_batch(Path(folder))


def made_up_scene(side: int, seed: int) -> tuple[Array, PinholeSensor]:
    """Draw a tilted wall with balls and pipes in front, 0.5 mm noise; return depth (side, side) and its sensor."""
    rng = np.random.default_rng(seed)
    f = 1.2 * side
    sensor = PinholeSensor(width_px=side, height_px=side, fx_px=f, fy_px=f, cx_px=(side - 1) / 2, cy_px=(side - 1) / 2)
    v, u = np.mgrid[:side, :side]
    x, y = (u - sensor.cx_px) / f, (v - sensor.cy_px) / f
    depth = 0.7 / (1.0 + 0.2 * x + 0.3 * y)
    for _ in range(5):
        cx, cy, cz = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(0.55, 0.62)
        r = rng.uniform(0.03, 0.05)
        a, b, c = x * x + y * y + 1.0, x * cx + y * cy + cz, cx * cx + cy * cy + cz * cz - r * r
        disc = b * b - a * c
        depth = np.where(disc > 0, np.minimum(depth, (b - np.sqrt(np.maximum(disc, 0.0))) / a), depth)
    return depth + rng.normal(0.0, 0.0005, depth.shape), sensor


def make_recordings(folder: Path, count: int) -> None:
    """Write `count` synthetic npz recordings of 256 x 256 pixels."""
    for k in range(count):
        depth, sensor = made_up_scene(256, k)
        view = {"kind": "pinhole", "shape": [256, 256], "f": sensor.fx_px, "cx": sensor.cx_px, "cy": sensor.cy_px}
        meta = np.array(json.dumps({"unit": "m", "sensor": view}))
        np.savez(folder / f"scan_{k:05d}.npz", depth=depth.astype(np.float32), meta=meta)


def critical_paths(side: int, repeats: int = 5) -> tuple[list[Path1], float]:
    """Return the critical paths for `TILES`, and the time of one image on one tile, in seconds."""
    depth, sensor = made_up_scene(side, 0)
    scene = analyse(depth, sensor)
    steps = _tiled_steps(depth, sensor, scene.labels)
    one = {tiles: [_slowest_tile(step, side, tiles, repeats) for step in steps] for tiles in TILES}
    whole = _median_s(lambda: analyse(depth, sensor), 3 if side > 1000 else 7)
    rest = max(whole - sum(one[1]), 0.0)
    # Fits run over regions, not rows; they are distributed evenly until each worker has one region.
    regions = max(len(scene.surfaces), 1)
    out = []
    for tiles in TILES:
        rounds = len(merge_rounds([top for top, _ in tile_rows(side, tiles)][1:]))
        seam = _seam_s(side) * rounds
        work = sum(one[tiles]) + rest / min(tiles, regions) + seam
        barriers = (len(steps) + rounds) if tiles > 1 else 0
        halo_s = HALO_ROWS * side * 8 * 8 / BITS_PER_S
        shared = work + barriers * SHARED_BARRIER_S
        out.append(Path1(tiles=tiles, shared_s=shared, message_s=work + barriers * (MESSAGE_S + halo_s)))
    return out, whole


def _tiled_steps(depth: Array, sensor: PinholeSensor, labels: NDArray[np.int32]) -> list[Callable[[int, int], object]]:
    """Return the pixel steps of the chain as functions of a row range."""
    packed, law = sensor.packed(), estimate_noise(depth, sensor).packed()
    H, W = depth.shape
    h, w = H // 2, W // 2
    x, y, z, sigma, rms = (np.full((h, w), np.nan) for _ in range(5))
    normal, count = np.full((h, w, 3), np.nan), np.zeros((h, w), np.int32)
    mean_blocks(depth, packed, law, 2, x, y, z, sigma, count, 0, h)
    mask, linked, parent = np.ones((H, W), bool), np.ones((H, W), bool), np.arange(H * W)
    n = int(labels.max())
    kinds, table = np.zeros(n + 1, np.int64), np.zeros((n + 1, SIZE))
    table[:, 2], table[:, 3] = -1.0, -0.6
    blocks = np.ascontiguousarray(labels[::2, ::2][:h, :w])
    out = np.empty((H, W), np.int32)
    rows, columns = contested_pixels(labels, 1, 0, H)
    names = np.empty_like(rows)

    def share(row: int) -> int:
        return int(rows.size * row // H)

    return [
        lambda a, b: geometry_of(depth[max(0, a - HALO_ROWS) : b + HALO_ROWS], sensor),
        lambda a, b: mean_blocks(depth, packed, law, 2, x, y, z, sigma, count, a // 2, b // 2),
        lambda a, b: tangent_planes(x, y, z, count, sigma, True, 1, 5.0 / packed[1], normal, rms, a // 2, b // 2),
        lambda a, b: _scan(mask, linked, linked, parent, a, b),
        lambda a, b: assign_pixels(depth, packed, law, blocks, 2, kinds, table, out, a // 2, b // 2),
        lambda a, b: contested_pixels(labels, 1, a, b),
        lambda a, b: reassign_pixels(
            depth, packed, law, labels, kinds, table, rows, columns, names, share(a), share(b)
        ),
    ]


def _slowest_tile(step: Callable[[int, int], object], rows: int, tiles: int, repeats: int) -> float:
    return max(_median_s(partial(step, *row), repeats) for row in tile_rows(rows, tiles))


def _seam_s(side: int) -> float:
    mask, linked = np.ones((4, side), bool), np.ones((4, side), bool)
    parent = np.arange(4 * side)
    return _median_s(lambda: _merge_seam(mask, linked, parent, 2), 9)


def _median_s(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return statistics.median(times)


def print_tiles(side: int) -> None:
    """Print the critical-path speed-up of one image of `side` x `side` pixels."""
    paths, whole = critical_paths(side)
    print(f"\none image of {side} x {side}: {1e3 * whole:.1f} ms on one tile (CPU time)")
    print(f"{'tiles':>6} {'shared ms':>10} {'speed-up':>9} {'efficiency':>11} {'messages ms':>12} {'speed-up':>9}")
    for p in paths:
        gain, far = paths[0].shared_s / p.shared_s, paths[0].message_s / p.message_s
        print(
            f"{p.tiles:6d} {1e3 * p.shared_s:10.2f} {gain:9.2f} {gain / p.tiles:11.2f} "
            f"{1e3 * p.message_s:12.2f} {far:9.2f}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Cluster:
    """Parameters of the simulation: times to hand over a task and to start a worker, stragglers, and a lost worker.

    A straggling task takes `straggle_factor` times as long with probability `straggle_share`. Worker 0 is lost at
    `lost_at_s` when that is finite; its running task starts again elsewhere after `notice_s`.
    """

    workers: int
    handover_s: float
    straggle_share: float = 0.0
    straggle_factor: float = 3.0
    lost_at_s: float = float("inf")
    notice_s: float = 2.0


def simulate(task_s: Array, cluster: Cluster, *, seed: int = 0) -> float:
    """Return the makespan in seconds for tasks of the given lengths (N,), served first come, first served.

    The scheduler hands over one task at a time, so `handover_s` limits how many workers it can keep busy.
    """
    rng = np.random.default_rng(seed)
    slow = rng.random(task_s.size) < cluster.straggle_share
    lengths = np.where(slow, cluster.straggle_factor * task_s, task_s)
    idle = [(0.0, k) for k in range(cluster.workers)]
    heapq.heapify(idle)
    waiting = [(0.0, k) for k in range(task_s.size)]
    heapq.heapify(waiting)
    scheduler_free, makespan = 0.0, 0.0
    while waiting:
        ready, task = heapq.heappop(waiting)
        free, worker = heapq.heappop(idle)
        start = max(free, ready, scheduler_free) + cluster.handover_s
        scheduler_free = start
        end = start + float(lengths[task])
        if worker == 0 and end > cluster.lost_at_s:
            # The worker does not return; its task is rescheduled when the loss is noticed.
            heapq.heappush(waiting, (max(cluster.lost_at_s, start) + cluster.notice_s, task))
            continue
        makespan = max(makespan, end)
        heapq.heappush(idle, (end, worker))
    return makespan


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskRun:
    """One task as measured by its worker: process id, wall clock at start and end, and CPU time, in seconds."""

    worker: int
    start_s: float
    end_s: float
    cpu_s: float


def stamped(paths: Sequence[str]) -> TaskRun:
    """Run `analyse_files` on one group of recordings and time it in the worker."""
    start_s, cpu_s = time.time(), time.process_time()
    analyse_files(paths)
    return TaskRun(worker=os.getpid(), start_s=start_s, end_s=time.time(), cpu_s=time.process_time() - cpu_s)


def measured_batch(groups: list[list[str]], workers: int) -> list[TaskRun]:
    """Return the tasks of a batch run on `workers` warm local workers, in the order in which they started."""
    with workers_of("local", workers) as client:
        client.run(warm_up)
        runs: list[TaskRun] = client.gather(client.map(stamped, groups, pure=False))
    return sorted(runs, key=lambda r: r.start_s)


def gaps_s(runs: Sequence[TaskRun]) -> Array:
    """Return the seconds between the end of a task and the start of the next on the same worker, the hand-over time."""
    last: dict[int, float] = {}
    out = []
    for run in runs:
        if run.worker in last:
            out.append(run.start_s - last[run.worker])
        last[run.worker] = run.end_s
    return np.array(out)


def print_batch(folder: Path) -> None:
    """Print measured runs with one and two workers beside the simulation, then the simulation up to 1024 workers.

    The simulation uses the task lengths of the same run, so that other load on the machine does not count, and the
    hand-over time of the run with one worker; it must predict when the last task ends.
    """
    groups = tasks_of(recordings_in(folder))
    images = sum(len(g) for g in groups)
    print(f"\nbatch of {images} images in {len(groups)} tasks of {IMAGES_A_TASK}")
    print(
        f"{'workers':>8} {'measured s':>11} {'simulated s':>12} {'apart':>7} {'CPU s':>7} {'efficiency by wall, by CPU':>27}"
    )
    one: list[TaskRun] = []
    handover_s, one_s = 0.0, 0.0
    for workers in (1, 2):
        runs = measured_batch(groups, workers)
        measured = max(r.end_s for r in runs) - runs[0].start_s
        if workers == 1:
            one, one_s, handover_s = runs, measured, float(np.mean(gaps_s(runs)))
        lengths = np.array([r.end_s - r.start_s for r in runs])
        # The measured span begins with the first task, after its hand-over.
        simulated = simulate(lengths, Cluster(workers=workers, handover_s=handover_s)) - handover_s
        cpu, one_cpu = (sum(r.cpu_s for r in some) for some in (runs, one))
        print(
            f"{workers:8d} {measured:11.2f} {simulated:12.2f} {100 * (simulated / measured - 1):6.1f}% {cpu:7.2f} "
            f"{one_s / measured / workers:15.2f} {one_cpu / cpu:11.2f}"
        )
    print(f"a hand-over takes {1e3 * handover_s:.1f} ms (mean)")
    print_carried(np.array([r.cpu_s for r in one]), handover_s)


def print_carried(lengths: Array, handover_s: float) -> None:
    """Print simulated makespans of 200 000 images: plain, with stragglers, and with one worker lost halfway."""
    many = np.random.default_rng(0).choice(lengths, 10_000)
    network_s = min(handover_s, 0.0005)  # an undisturbed scheduler needs 200 to 500 us per task
    print(f"\nsimulated, 10000 tasks, {1e3 * network_s:.2f} ms a hand-over")
    print(f"{'workers':>8} {'plain s':>9} {'efficiency':>11} {'2 % stragglers x3':>18} {'one lost':>9}")
    for workers in WORKERS:
        plain = simulate(many, Cluster(workers=workers, handover_s=network_s))
        slow = simulate(many, Cluster(workers=workers, handover_s=network_s, straggle_share=0.02))
        losing = Cluster(workers=workers, handover_s=network_s, lost_at_s=plain / 2)
        lost = simulate(many, losing) if workers > 1 else np.nan
        efficiency = many.sum() / plain / workers
        print(f"{workers:8d} {plain:9.1f} {efficiency:11.2f} {slow:18.1f} {lost:9.1f}")


if __name__ == "__main__":
    main()
