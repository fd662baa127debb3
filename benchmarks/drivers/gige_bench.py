"""Test setup of a GigE Vision camera: Aravis' program, one at a time on a machine, whose frames show a moving ramp.

What applies of the faults: packets that are lost (`drop`), a camera that stops for a while, and one that is switched off.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import threading
from contextlib import suppress
from typing import Any

import numpy as np

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.cameras import ADDRESS, FAKE, start_fake
from drivers.emulators.faults import FaultOptions, WireFault
from hal.devices import Image
from hal.errors import DeviceUnavailable
from hal.strict import validate

RATE_HZ, PACKET_BYTES, WIDTH_PX, HEIGHT_PX = 25.0, 1400, 128, 96
PACKETS = 9 + 2  # of a frame, with its leader and its trailer
LEVELS = 255  # after so many, the ramp begins again
FAULTS = (WireFault.DROP, WireFault.SILENT, WireFault.DISCONNECT)


class FakeCamera:
    """Aravis' camera, in which a thread makes a fault once in so many frames."""

    def __init__(self, _: None, options: dict[str, Any]) -> None:
        if shutil.which(FAKE) is None:
            raise DeviceUnavailable(f"{FAKE} is not installed", hint="install the package aravis-tools")
        self._o = validate(options, FaultOptions, source="far side")
        self._kinds = self._o.mixed or ((self._o.fault,) if self._o.fault else ())
        is_lossy = WireFault.DROP in self._kinds
        self._arguments = ("-r", str(max(1, round(1000 / (self._o.every * PACKETS))))) if is_lossy else ()
        self._process = start_fake(*self._arguments)
        self._using, self._closing = threading.Lock(), threading.Event()
        self.address = {"camera": ADDRESS}
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self, *, away_s: float) -> None:
        """Switch the camera off, and on again after a while; returns when it answers."""
        with self._using:
            self._kill()
            self._closing.wait(away_s)
            self._process = start_fake(*self._arguments)

    def close(self) -> None:
        """End the thread and the program."""
        self._closing.set()
        self._thread.join(5.0)
        with self._using:
            self._kill()

    def _run(self) -> None:
        chosen = [kind for kind in self._kinds if kind is not WireFault.DROP]
        for number in range(1_000_000):
            if self._closing.wait(self._o.every / RATE_HZ) or not chosen:
                return
            if chosen[number % len(chosen)] is WireFault.DISCONNECT:
                self.unplug(away_s=self._o.away_s)
            else:
                with self._using:
                    self._process.send_signal(signal.SIGSTOP)
                    self._closing.wait(self._o.silent_s)
                    self._process.send_signal(signal.SIGCONT)

    def _kill(self) -> None:
        with suppress(ProcessLookupError):
            self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(2.0)


def _is_ramp(value: Image, _: None) -> bool:
    rows, columns = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX]
    pixels = value.pixels.astype(int)
    return pixels.shape == rows.shape and bool(np.all(pixels == (pixels[0, 0] + rows + columns) % LEVELS))


GIGE_BENCHES = (
    Bench(
        name="gige",
        start=FakeCamera,
        backing=lambda: None,
        driver="gige:camera",
        is_true=_is_ramp,
        options={"rate_hz": RATE_HZ, "width_px": WIDTH_PX, "height_px": HEIGHT_PX, "packet_bytes": PACKET_BYTES},
        faults=FAULTS,
        stamps="device",
        is_alone=True,
    ),
)
