"""Measures calls, rates and decoders on a good link."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.drivers.benches import bench, running
from benchmarks.drivers.report import cpu_rate, deadline, line, percentiles
from drivers.emulators import ft300, rplidar, scip, tfmini
from drivers.ft300 import stream_framer
from drivers.rplidar.nodes import decode
from drivers.scip import decode_ranges_mm
from drivers.tfmini import data_framer


def part_latency(seconds: float) -> None:  # noqa: ARG001  # a number of reads
    """Measure what a read of the newest sample takes."""
    with running(bench("ft300 modbus"), {}) as (device, _, _):
        reads_s = []
        for _ in range(5000):
            started_s = time.perf_counter()
            device.read_wrench(deadline=deadline())
            reads_s.append(time.perf_counter() - started_s)
    p50, p99 = percentiles(reads_s)
    line(
        "driver read from its mailbox, p50 / p99",
        "+80 / +300 us",
        f"{p50:.0f} / {p99:.0f} us",
        p50 <= 80 and p99 <= 300,
    )


def part_decode(seconds: float) -> None:
    """Measure the points and frames decoded per second of CPU time."""
    data = scip.encode_ranges(np.arange(1081) % 4000)
    points = cpu_rate(lambda: decode_ranges_mm(data), seconds) * 1081
    line("SCIP ranges decoded, points/s", "20 M", f"{points / 1e6:.0f} M", points >= 20e6)
    turn = rplidar.encode_turn(np.arange(3600) * 2 * np.pi / 3600, np.full(3600, 1.0))
    nodes = np.frombuffer(turn * 4, np.uint8).reshape(-1, 5)
    points = cpu_rate(lambda: decode(nodes), seconds) * len(nodes)
    line("RPLIDAR measurements decoded, points/s", "20 M", f"{points / 1e6:.0f} M", points >= 20e6)
    frames = b"".join(tfmini.data_frame(i, 500) for i in range(500))
    count = cpu_rate(lambda: data_framer().feed(frames), seconds) * 500
    line("TFmini frames/s (9 bytes, sum)", "100 k", f"{count / 1e3:.0f} k", count >= 100e3)
    frames = b"".join(ft300.stream_frame([i, 2, 3, 4, 5, 6]) for i in range(500))
    count = cpu_rate(lambda: stream_framer().feed(frames), seconds) * 500
    line("FT 300 frames/s (16 bytes, CRC)", "100 k", f"{count / 1e3:.0f} k", count >= 100e3)
