"""Shows a running service in Foxglove while it works: joints, frames, wrench, images, and what its tasks do."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from hal.devices import DeviceKind, RangeScannerCapabilities
from hal.errors import CellError
from hal.geometry import from_json
from service.recording import foxglove

FRAMES_S = 1.0


class Screen(Protocol):
    """Where messages are shown; `service.recording.live.LiveServer`."""

    def show(self, topic: str, message: Any, *, time_ns: int) -> None:
        """Show a message of Foxglove's."""
        ...

    def show_json(self, topic: str, value: Any, *, time_ns: int) -> None:
        """Show plain values."""
        ...


class Asks(Protocol):
    """The part of a client that the view needs."""

    def get(self, path: str) -> Any:
        """Return the JSON answer to a GET request."""
        ...

    def fetch(self, method: str, path: str) -> bytes:
        """Return the bytes of an answer."""
        ...


class LiveView:
    """Asks a service for what it sees, and shows it.

    Args:
        now_ns: wall time in nanoseconds.
    """

    def __init__(self, client: Asks, screen: Screen, *, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._client = client
        self._screen = screen
        self._now_ns = now_ns
        self._steps: dict[str, str] = {}
        self._scanners: dict[str, RangeScannerCapabilities] = {}

    def show_state(self, sample: dict[str, Any]) -> None:
        """Show a sample of `WS /v1/stream`."""
        now_ns = self._now_ns()
        self._screen.show_json("/state", sample, time_ns=now_ns)
        if "position_rad" not in sample:
            return
        names = [f"arm_{k + 1}" for k in range(len(sample["position_rad"]))]
        joints = foxglove.joints_message(names, sample["position_rad"], sample["velocity_rad_per_s"], time_ns=now_ns)
        self._screen.show("/joint_states", joints, time_ns=now_ns)
        links = {"flange": ("base", from_json(sample["base_from_flange"]))}
        if sample.get("base_from_panel") is not None:
            links["panel"] = ("base", from_json(sample["base_from_panel"]))
        self._screen.show("/tf", foxglove.transforms_message(links, time_ns=now_ns), time_ns=now_ns)

    def show_frames(self) -> None:
        """Show where the devices are mounted.

        Raises:
            ApiError, DeviceUnavailable: the service does not answer.
        """
        frames = self._client.get("/v1/frames")["frames"]
        mounts = {f["child"]: (f["parent"], from_json(f)) for f in frames if f["source"] == "calibration"}
        now_ns = self._now_ns()
        self._screen.show("/tf", foxglove.transforms_message(mounts, time_ns=now_ns), time_ns=now_ns)

    def show_tasks(self) -> None:
        """Show each new step of each task as a line of the log; errors as for `show_frames`."""
        for task in self._client.get("/v1/tasks")["tasks"]:
            step = f"{task['verb']} {task['state']}: {task['step']}"
            if self._steps.get(task["id"]) != step:
                self._steps[task["id"]] = step
                now_ns = self._now_ns()
                level = "error" if task["state"] == "failed" else "info"
                line = foxglove.log_message(step, name=task["verb"], time_ns=now_ns, level=level)
                self._screen.show("/log", line, time_ns=now_ns)

    def show_pictures(self) -> None:
        """Show one image of each camera and range scanner; one that gives none is left out. Errors as for `show_frames`."""
        for device in self._client.get("/v1/devices")["devices"]:
            with suppress(CellError):
                if device["kind"] == DeviceKind.CAMERA:
                    self._show_image(device["name"])
                elif device["kind"] == DeviceKind.RANGE_SCANNER:
                    self._show_range(device["name"])

    def _arrays(self, name: str) -> Any:
        data = self._client.fetch("GET", f"/v1/devices/{name}/reading?format=npz")
        return np.load(io.BytesIO(data), allow_pickle=False)

    def _show_image(self, name: str) -> None:
        pixels, now_ns = self._arrays(name)["pixels"], self._now_ns()
        image = foxglove.image_message(pixels, frame=name, time_ns=now_ns)
        self._screen.show(f"/{name}/image", image, time_ns=now_ns)

    def _show_range(self, name: str) -> None:
        if name not in self._scanners:
            told = self._client.get(f"/v1/devices/{name}")["capabilities"]
            self._scanners[name] = RangeScannerCapabilities(**told)
        depth_m, now_ns = self._arrays(name)["depth_m"], self._now_ns()
        image = foxglove.depth_message(depth_m, frame=name, time_ns=now_ns)
        self._screen.show(f"/{name}/range", image, time_ns=now_ns)
        points = foxglove.points_message(depth_m, self._scanners[name], frame=name, time_ns=now_ns)
        self._screen.show(f"/{name}/points", points, time_ns=now_ns)


def repeat(work: Callable[[], None], period_s: float, end: threading.Event) -> threading.Thread:
    """Run `work` every `period_s` in a thread until `end`; an error of the service is left to the next attempt."""

    def run() -> None:
        while not end.wait(period_s):
            with suppress(CellError):
                work()

    thread = threading.Thread(target=run, name="live-view", daemon=True)
    thread.start()
    return thread
