"""Measures `gige:camera` against Aravis' fake GigE Vision camera, which stamps its frames with the time of this machine."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.drivers.report import line
from drivers.gige.source import probe
from drivers.transport.link import WireError
from hal.clock import Deadline
from hal.registry import Context, connect

FAKE = "arv-fake-gv-camera-0.8"
ADDRESS = "127.0.0.1"
RATE_HZ = 25.0
UNPLUGGED = 20


def part_cameras(seconds: float) -> None:
    """Measure lost frames and stamps over `seconds` (400 s are 10 000 frames), and the time to come back."""
    if shutil.which(FAKE) is None:
        print(f"cameras: skipped, {FAKE} of the package aravis-tools is not installed")
        return
    _measure_stream(seconds)
    _measure_reconnect()


def _measure_stream(seconds: float) -> None:
    error_s, seen = list[float](), 0
    with _fake():
        device = _connect()
        end_s, rest = time.monotonic() + seconds, threading.Event()
        while time.monotonic() < end_s:
            rest.wait(0.1)
            for sample in device.mailbox.since(seen)[0]:
                seen = sample.sequence
                sent_s = sample.device_time_s - (time.time() - time.monotonic())
                error_s.append(sample.host_time_s + sample.value.exposure_s - sent_s)
        ages_s = _ages(device)
        frames = device.mailbox.published
        lost, counts = device.mailbox.peek().sequence - frames, device.wire_counts()
        device.close()
    p99_ms = 1e3 * float(np.quantile(np.abs(np.array(error_s) - np.median(error_s)), 0.99))
    line(f"gige: frames lost of {frames} at {RATE_HZ:.0f} Hz, 512x512", "0", f"{lost} ({counts})", lost == 0)
    line("gige: stamp jitter, p99", "2 ms", f"{p99_ms:.2f} ms", p99_ms <= 2.0)
    offset_ms = 1e3 * float(np.median(error_s))
    line("gige: stamp behind the camera's, median", "2 ms", f"{offset_ms:.2f} ms", abs(offset_ms) <= 2.0)
    age_ms = 1e3 * float(np.median(ages_s))
    line("gige: age of a frame just read, median", "60 ms", f"{age_ms:.1f} ms", age_ms <= 60.0)


def _ages(device: Any) -> list[float]:
    clock = device.context.clock
    return [device.read_image(deadline=Deadline.after(clock, 1.0)).age_s(clock.now_s()) for _ in range(25)]


def _measure_reconnect() -> None:
    took_s = []
    with _fake() as far:
        device = _connect()
        for _ in range(UNPLUGGED):
            far[0].kill()
            far[0].wait()
            threading.Event().wait(0.5)
            far[0] = start_fake()
            answered_s, count = time.monotonic(), device.mailbox.published
            while device.mailbox.published == count and time.monotonic() < answered_s + 10.0:
                threading.Event().wait(0.002)
            took_s.append(time.monotonic() - answered_s)
        device.close()
    line(f"gige: back after re-plug, worst of {UNPLUGGED}", "1 s", f"{max(took_s):.2f} s", max(took_s) <= 1.0)


def _connect() -> Any:
    return connect(Context(name="eye"), "gige:camera", {"camera": ADDRESS, "rate_hz": RATE_HZ, "exposure_s": 0.005})


@contextmanager
def _fake() -> Iterator[list[subprocess.Popen[bytes]]]:
    far = [start_fake()]
    try:
        yield far
    finally:
        far[0].kill()
        far[0].wait()


def start_fake(*arguments: str) -> subprocess.Popen[bytes]:
    """Start Aravis' camera and wait until it answers."""
    process = subprocess.Popen([FAKE, "-i", ADDRESS, "-s", "B1", *arguments])
    while True:
        try:
            probe(ADDRESS)
            return process
        except WireError:
            threading.Event().wait(0.01)
