"""Measures the time from the arrival of a recorded depth frame to its named surfaces, end to end.

    python -m benchmarks.range_stream [--first SEED] [--seeds N] [--rounds N]

Pictures of 640x480 pixels (16-bit PNG, 0.1 mm a count) of the generator's scenes are played by the driver `files:depth`.
The time runs from the frame's stamp over reading and decoding the file to the surfaces with their kinds and parameters.
The ratio is that to the filter pass over the same images in the same run (`benchmarks.range_filter_pass`).
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.range import case_depth, drawn_cases, range_module
from benchmarks.range_filter_pass import filter_pass
from drivers.depth_camera import DepthCamera, DepthCameraOptions
from hal.arrays import Array
from hal.clock import Deadline, WallClock
from hal.registry import Context
from perception.range import analyse
from perception.range.recordings import sensor_from_meta
from perception.range.sensor import RangeSensorModel

UNIT_M = 1e-4
RATE_HZ = 5.0
SCENES = ("polyhedra", "curved", "panel", "fig10")


@dataclass(slots=True, kw_only=True)
class Timed:
    """Times in milliseconds: from arrival to surfaces, of the driver alone, of the CPU, and of the filter pass."""

    whole_ms: list[float]
    driver_ms: list[float]
    cpu_ms: list[float]
    filter_ms: list[float]
    surfaces: int = 0


def record(folder: Path, scene: str, first: int, seeds: int) -> RangeSensorModel:
    """Write pictures of one scene with several seeds, and return the sensor's model."""
    sensor: RangeSensorModel | None = None
    for case in drawn_cases(range_module("gen"), scene, first, seeds, n=480, aspect=4 / 3):
        depth_m = np.nan_to_num(case_depth(case, False))
        pixels = np.clip(np.round(depth_m / UNIT_M), 0, 65_535).astype(np.uint16)
        cv2.imwrite(str(folder / f"{case['meta']['seed']:05d}.png"), pixels)
        sensor = sensor_from_meta(case["meta"]["sensor"], 1e-3)
    assert sensor is not None
    return sensor


def timed(scene: str, first: int, seeds: int, rounds: int) -> Timed:
    """Play the pictures `rounds` times and analyse each frame."""
    out = Timed(whole_ms=[], driver_ms=[], cpu_ms=[], filter_ms=[])
    with tempfile.TemporaryDirectory() as name:
        sensor = record(Path(name), scene, first, seeds)
        is_pinhole, fx, fy, cx, cy = sensor.packed()
        options = DepthCameraOptions(
            path=Path(name),
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            projection="pinhole" if is_pinhole else "orthographic",
            unit_m=UNIT_M,
            rate_hz=RATE_HZ,
        )
        clock, camera = WallClock(), DepthCamera(Context(name="camera"), options)
        for index in range(seeds * rounds):
            cpu_s = time.process_time()
            sample = camera.read_range(deadline=Deadline.after(clock, 5.0))
            arrived_s, got_s = sample.host_time_s, clock.now_s()
            scene_found = analyse(sample.value.depth_m, sensor)
            ended_s = clock.now_s()
            if index < seeds:  # the first round loads the compiled kernels
                continue
            out.surfaces += len(scene_found.surfaces)
            out.whole_ms.append(1e3 * (ended_s - arrived_s))
            out.driver_ms.append(1e3 * (got_s - arrived_s))
            out.cpu_ms.append(1e3 * (time.process_time() - cpu_s))
            out.filter_ms.append(_wall_ms(np.asarray(sample.value.depth_m, float), sensor))
        camera.close()
    return out


def _wall_ms(depth_m: Array, sensor: RangeSensorModel) -> float:
    started_s = time.perf_counter()
    filter_pass(depth_m, sensor)()
    return 1e3 * (time.perf_counter() - started_s)


def main() -> None:
    """Print one line for each scene and one for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=900)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=6)
    arguments = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    parts = {scene: timed(scene, arguments.first, arguments.seeds, arguments.rounds) for scene in SCENES}
    every = Timed(whole_ms=[], driver_ms=[], cpu_ms=[], filter_ms=[])
    for part in parts.values():
        for name in ("whole_ms", "driver_ms", "cpu_ms", "filter_ms"):
            getattr(every, name).extend(getattr(part, name))
        every.surfaces += part.surfaces
    for name, part in {**parts, "all": every}.items():
        whole, ratio = statistics.median(part.whole_ms), np.divide(part.whole_ms, part.filter_ms)
        print(
            f"{name:<10} {len(part.whole_ms)} frames, {part.surfaces} surfaces: median {whole:.1f} ms, p99"
            f" {np.quantile(part.whole_ms, 0.99):.1f} ms; reading the file {statistics.median(part.driver_ms):.1f} ms;"
            f" CPU of both {statistics.median(part.cpu_ms):.1f} ms; {np.median(ratio):.1f} filter passes"
        )


if __name__ == "__main__":
    main()
