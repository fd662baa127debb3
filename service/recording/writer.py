"""Writes a recording: an MCAP file that Foxglove shows as it is and that holds every value to the bit.

It runs in a process of its own (`hal.host_process`), so that writing costs the cell no time, and the file is ended
properly when the other processes die. Everything is written at the latest a second after it arrives.

| topic | schema | what |
| --- | --- | --- |
| `/calls/OBJECT` | `panelwright.Call`, JSON | each call of a device, the mover or the clock with its answer |
| `/control/DEVICE/METHOD` | `panelwright.*`, Protobuf | each reading and command of the control loop |
| `/events` | `panelwright.Event`, JSON | tasks with request and result, stops, exchanges of devices |
| `/DEVICE/image`, `/DEVICE/range`, `/DEVICE/points` | Foxglove's | images; a call refers to its image by topic and sequence |
| `/DEVICE/calibration`, `/joint_states`, `/tf`, `/log` | Foxglove's | for people |
"""

from __future__ import annotations

import contextlib
import json
import pickle
import signal
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from google.protobuf.message import Message
from mcap.writer import Writer
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.calibration import CameraIntrinsics
from hal.devices import RangeScannerCapabilities
from hal.frames import BASE, FLANGE
from service.recording import foxglove
from service.recording.codec import LISTED, encode
from service.recording.samples import FORMS, Row, sample_of
from service.recording.sender import Dropped, Note
from service.recording.tap import Call, Started

PROFILE = "panelwright"
FORMAT = 1  # of the topics above; a reader refuses a newer one
FLUSH_S = 1.0
JOINTS_S, FRAMES_S = 0.02, 0.05  # least time between two messages for people; `/control` has every reading
EVENTS = "/events"
CALL_SCHEMA = {
    "type": "object",
    "title": "panelwright.Call",
    "description": "One call of a device, the mover or the clock. See service/recording/codec.py for the values.",
    "properties": {
        "number": {"type": "integer", "description": "order in which the calls of the cell ended"},
        "caller": {"type": "string", "description": "task (VERB ID), `control`, or empty"},
        "object": {"type": "string"},
        "method": {"type": "string"},
        "arguments": {"type": "array"},
        "keywords": {"type": "object"},
        "value": {"description": "the answer"},
        "error": {"description": "what it raised instead"},
        "time_s": {"type": "number", "description": "cell time at the end of the call"},
    },
}
EVENT_SCHEMA = {
    "type": "object",
    "title": "panelwright.Event",
    "properties": {"kind": {"type": "string"}, "data": {"type": "object"}},
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contents:
    """What a recording says about its cell.

    Attributes:
        about: facts for the file's metadata.
        files: the cell file, and every file that it refers to, by name.
        mounts: parent and `parent_from_device` of each mounted device.
        lenses: intrinsics of each camera.
    """

    about: Mapping[str, str]
    files: Mapping[str, bytes]
    mounts: Mapping[str, tuple[str, RigidTransform]]
    lenses: Mapping[str, CameraIntrinsics]


def make_recorder(path: Path, contents: Contents) -> dict[str, object]:
    """Return the recorder for `hal.host_process.HostProcess`, which ends it when this process's parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the parent, which ends this
    return {"recorder": Recorder(path, contents)}


def _writer(stream: BinaryIO) -> Any:
    return Writer(stream)  # untyped, because `flush` and `finish` of the library are


class Recorder:
    """Writes what senders deliver. Threads may share it.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, contents: Contents) -> None:
        self._contents = contents
        self._stream = path.open("xb")
        self._writer = _writer(self._stream)
        self._lock = threading.Lock()
        self._channels: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self._problem = ""
        self._is_closed = False
        self._cell: Started | None = None
        self._last_ns = self._epoch_ns = time.time_ns()
        self._epoch_wall_s = time.monotonic()
        self._shown_s: dict[str, float] = {}
        self._writer.start(profile=PROFILE)
        self._writer.add_metadata(PROFILE, {**contents.about, "format": str(FORMAT)})
        for name, data in contents.files.items():
            self._writer.add_attachment(self._epoch_ns, self._epoch_ns, name, "application/toml", data)
        self._writer.flush()
        self._flushed_s = time.monotonic()

    def take(self, batch: bytes) -> str:
        """Write a batch of `sender.packed`; returns why the recording cannot go on, or an empty text."""
        with self._lock:
            if self._is_closed or self._problem:
                return self._problem or "the recording is closed"
            try:
                for item in pickle.loads(batch):  # noqa: S301 - from a process of this service, behind its key
                    self._write(item)
                if time.monotonic() - self._flushed_s > FLUSH_S:
                    self._writer.flush()
                    self._flushed_s = time.monotonic()
            except OSError as error:
                self._problem = f"{self._stream.name}: {error.strerror or error}"
            return self._problem

    def flush(self) -> None:
        """Write everything that was delivered to the file."""
        with self._lock:
            self._writer.flush()

    def close(self) -> None:
        """Write the index and close the file; a second call does nothing."""
        with self._lock, contextlib.suppress(OSError):  # a full disk: what was flushed stays readable
            if not self._is_closed:
                self._is_closed = True
                self._writer.finish()
                self._stream.close()

    def _write(self, item: Any) -> None:
        match item:
            case tuple():
                self._row(Row(*item))
            case Call():
                self._call(item)
            case Started():
                self._begin(item)
            case Note():
                self._event(item.kind, item.data, item.wall_s)
            case Dropped():
                self._event("recording-dropped", {"readings": item.rows}, time.monotonic())

    def _begin(self, started: Started) -> None:
        self._cell = started
        self._epoch_ns, self._epoch_wall_s = max(started.epoch_ns, self._last_ns), started.wall_s
        objects = {
            name: {
                "methods": list(served.methods),
                "constants": encode(served.constants),
                "capabilities": encode(served.capabilities),
                "health": encode(served.health),
            }
            for name, served in started.objects.items()
        }
        self._event("cell-objects", {"objects": objects, "time_s": started.time_s}, started.wall_s)

    def _row(self, row: Row) -> None:
        assert self._cell is not None  # noqa: S101 - narrowing: a cell sends `Started` first
        device, kind, method = self._cell.places[row.place]
        form = FORMS[kind, method]
        at_ns = self._at_ns(row.time_s)
        self._message(f"/control/{device}/{method}", sample_of(form, row, at_ns), at_ns, row.wall_s)
        if form.name == "JointReading":
            self._arm(device, row, at_ns)

    def _arm(self, device: str, row: Row, at_ns: int) -> None:
        """Write joints and frames for people, not as often as they are read."""
        assert self._cell is not None  # noqa: S101 - narrowing: as in `_row`
        arm, (position, velocity, *_) = self._cell.objects[device].capabilities, row.values
        if self._is_due("/joint_states", row.time_s, JOINTS_S):
            names = [f"{device}_{k + 1}" for k in range(len(position))]
            shown = foxglove.joints_message(names, position, velocity, time_ns=at_ns)
            self._message("/joint_states", shown, at_ns, row.wall_s)
        if arm is not None and self._is_due("/tf", row.time_s, FRAMES_S):
            flange = {FLANGE: (BASE, foxglove.base_from_flange(arm.links, position))}
            frames = foxglove.transforms_message({**flange, **self._contents.mounts}, time_ns=at_ns)
            self._message("/tf", frames, at_ns, row.wall_s)

    def _is_due(self, topic: str, time_s: float, period_s: float) -> bool:
        is_due = not 0.0 <= time_s - self._shown_s.get(topic, -np.inf) < period_s
        if is_due:
            self._shown_s[topic] = time_s
        return is_due

    def _call(self, call: Call) -> None:
        at_ns = self._at_ns(call.time_s)

        def picture(array: NDArray[Any]) -> dict[str, Any] | None:
            return self._picture(call, array, at_ns)

        written = {
            "number": call.number,
            "caller": call.caller,
            "object": call.object,
            "method": call.method,
            "arguments": encode(call.arguments),
            "keywords": {key: encode(value) for key, value in call.keywords.items()},
            "value": encode(call.value, picture),
            "error": call.error,
            "time_s": call.time_s,
        }
        topic = f"/calls/{call.object}"
        self._json(topic, "panelwright.Call", CALL_SCHEMA, written, at_ns, call.wall_s)

    def _picture(self, call: Call, array: NDArray[Any], at_ns: int) -> dict[str, Any] | None:
        """Write an image to a topic of its own and return the reference; None for an array that is none."""
        name = call.object
        shown: Message | None = None
        if call.method == "read_image" and foxglove.is_picture(array):
            topic, shown = f"/{name}/image", foxglove.image_message(array, frame=name, time_ns=at_ns)
            if name in self._contents.lenses:
                lens = foxglove.calibration_message(self._contents.lenses[name], frame=name, time_ns=at_ns)
                self._message(f"/{name}/calibration", lens, at_ns, call.wall_s)
        if array.dtype == np.float32 and array.ndim == 2:
            self._points(name, array, at_ns, call.wall_s)
            if array.flags.c_contiguous and array.shape[0] > 1 and array.size > LISTED:
                topic, shown = f"/{name}/range", foxglove.depth_message(array, frame=name, time_ns=at_ns)
        if shown is None:
            return None
        return {"$picture": {"topic": topic, "sequence": self._message(topic, shown, at_ns, call.wall_s)}}

    def _points(self, name: str, depth_m: NDArray[np.float32], at_ns: int, wall_s: float) -> None:
        served = self._cell.objects.get(name) if self._cell is not None else None
        if served is not None and isinstance(served.capabilities, RangeScannerCapabilities):
            points = foxglove.points_message(depth_m, served.capabilities, frame=name, time_ns=at_ns)
            self._message(f"/{name}/points", points, at_ns, wall_s)

    def _event(self, kind: str, data: dict[str, Any], wall_s: float) -> None:
        self._json(EVENTS, "panelwright.Event", EVENT_SCHEMA, {"kind": kind, "data": data}, self._last_ns, wall_s)
        if kind != "cell-objects":
            text = foxglove.log_message(said(kind, data), name=kind, time_ns=self._last_ns, level=level_of(kind, data))
            self._message("/log", text, self._last_ns, wall_s)

    def _at_ns(self, time_s: float) -> int:
        """Return the log time of a moment on the cell's clock: a simulated second is a second, however long it took."""
        if self._cell is not None:
            self._last_ns = self._epoch_ns + round(1e9 * (time_s - self._cell.time_s))
        return self._last_ns

    def _message(self, topic: str, message: Message, at_ns: int, wall_s: float) -> int:
        kind: Any = type(message)
        schema = (kind.DESCRIPTOR.full_name, "protobuf", foxglove.schema_of(kind))
        return self._add(topic, "protobuf", schema, message.SerializeToString(), at_ns, wall_s)

    def _json(self, topic: str, name: str, schema: dict[str, Any], value: Any, at_ns: int, wall_s: float) -> None:
        text = json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
        self._add(topic, "json", (name, "jsonschema", json.dumps(schema).encode()), text, at_ns, wall_s)

    def _add(
        self, topic: str, encoding: str, schema: tuple[str, str, bytes], data: bytes, at_ns: int, wall_s: float
    ) -> int:
        """Write one message and return its sequence number on its topic."""
        if topic not in self._channels:
            number = self._writer.register_schema(*schema)
            self._channels[topic] = self._writer.register_channel(topic, encoding, number)
        self._sequences[topic] = sequence = self._sequences.get(topic, 0) + 1
        publish_ns = self._epoch_ns + round(1e9 * (wall_s - self._epoch_wall_s))
        self._writer.add_message(self._channels[topic], at_ns, data, publish_ns, sequence)
        return sequence


def said(kind: str, data: Mapping[str, Any]) -> str:
    """Return an event as a line for people."""
    short = {key: value for key, value in data.items() if isinstance(value, str | int | float) and value != ""}
    return f"{kind}: " + ", ".join(f"{key} {value}" for key, value in short.items())


def level_of(kind: str, data: Mapping[str, Any]) -> str:
    """Return how grave an event is, in the words of `foxglove.LEVELS`."""
    if kind in ("stop", "cell-down", "recording-dropped") or data.get("state") == "failed":
        return "warning"
    return "info"
