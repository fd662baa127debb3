"""Far sides of cameras: programs that nobody here wrote, on the loop-back, one at a time on this machine."""

from __future__ import annotations

import ctypes.util
import fcntl
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.gige.source import probe
from drivers.transport.link import WireError
from hal.simulated import Fault
from tests.drivers.rigs import until

FAKE = "arv-fake-gv-camera-0.8"  # of Debian's package aravis-tools
ADDRESS = "127.0.0.1"


@contextmanager
def only_one(what: str) -> Iterator[None]:
    """Hold a lock of this machine, because the port of a GigE camera is fixed."""
    with (Path(tempfile.gettempdir()) / f"panelwright-test-{what}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def need_aravis() -> None:
    """Skip the test where Aravis is not installed."""
    if ctypes.util.find_library("aravis-0.8") is None:
        pytest.skip("libaravis-0.8-0 is not installed")


class FakeGigeCamera:
    """Aravis' program that plays a GigE Vision camera; its frames carry a moving pattern and the time of day."""

    def __init__(self, *arguments: str) -> None:
        self._arguments = arguments
        self.start()

    def start(self) -> None:
        """Start the program and wait until it answers."""
        self._process = subprocess.Popen([FAKE, "-i", ADDRESS, "-s", "T1", *self._arguments])
        until(self.answers)

    def answers(self) -> bool:
        """Return whether the camera can be found."""
        try:
            probe(ADDRESS)
        except WireError:
            return False
        return True

    def inject(self, fault: Fault | None) -> None:
        """Stop, kill or revive the program."""
        if fault is Fault.SILENT:
            self._process.send_signal(signal.SIGSTOP)
        elif fault is Fault.DISCONNECTED:
            self.close()
        elif self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
        else:
            self.start()

    def close(self) -> None:
        """End the program."""
        self._process.kill()
        self._process.wait()


@contextmanager
def fake_gige(*arguments: str) -> Iterator[FakeGigeCamera]:
    """Run the fake camera, or skip the test where it is not installed."""
    need_aravis()
    if shutil.which(FAKE) is None:
        pytest.skip(f"{FAKE} of the package aravis-tools is not installed")
    with only_one("gige"):
        camera = FakeGigeCamera(*arguments)
        try:
            yield camera
        finally:
            camera.inject(None)
            camera.close()


def free_port() -> int:
    """Return a TCP port that is free now."""
    with socket.socket() as probe_socket:
        probe_socket.bind((ADDRESS, 0))
        return int(probe_socket.getsockname()[1])
