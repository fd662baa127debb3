"""Gives the newest readings of devices as JSON, PNG or npz; one read serves all callers."""

from __future__ import annotations

import io
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.clock import Deadline
from hal.devices import DeviceKind, Image, RangeImage, RangeScannerCapabilities
from hal.errors import InvalidRequest
from hal.readings import Stamped
from service.jsonable import jsonable
from service.processes.connection import CellConnection

READ_TIMEOUT_S = 2.0
READS: dict[DeviceKind, str] = {
    DeviceKind.ARM: "read_state",
    DeviceKind.GRIPPER: "read_state",
    DeviceKind.CAMERA: "read_image",
    DeviceKind.RANGE_SCANNER: "read_range",
    DeviceKind.PROXIMITY: "read_distance_m",
    DeviceKind.TOUCH: "read_contacts",
    DeviceKind.FORCE_TORQUE: "read_wrench",
    DeviceKind.LIGHTS: "read_on",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReceivedReading:
    """A reading and the monotonic time in seconds at which this process got it."""

    stamped: Stamped[Any]
    age_s: float
    got_s: float


class ReadingDesk:
    """Reads a device when its newest snapshot is too old; a lock per device lets several callers share one read.

    Args:
        connection: returns the cell's connection, which may change when the cell is restarted.
    """

    def __init__(self, connection: Callable[[], CellConnection]) -> None:
        self._connection = connection
        self._lock = threading.Lock()
        self._device_locks: dict[str, threading.Lock] = {}
        self._snapshots: dict[str, ReceivedReading] = {}
        self._pictures: dict[str, tuple[ReceivedReading, bytes]] = {}

    def read(self, name: str, *, max_age_s: float) -> ReceivedReading:
        """Return a reading of the device that is at most `max_age_s` old.

        Raises:
            InvalidRequest: there is no such device.
            DeviceError: the device gives no reading.
        """
        connection = self._connection()
        device = connection.device(name)
        with self._lock:
            device_lock = self._device_locks.setdefault(name, threading.Lock())
        with device_lock:
            newest = self._snapshots.get(name)
            if newest is not None and time.monotonic() - newest.got_s < max_age_s:
                return newest
            kind = connection.cell.file.devices[name].kind
            stamped = getattr(device, READS[kind])(deadline=Deadline.after(connection.clock, READ_TIMEOUT_S))
            age_s = stamped.age_s(connection.clock.now_s())
            snapshot = ReceivedReading(stamped=stamped, age_s=age_s, got_s=time.monotonic())
            self._snapshots[name] = snapshot
            return snapshot

    def forget(self, name: str) -> None:
        """Drop the readings of the device called `name`, because another device was installed."""
        self._snapshots.pop(name, None)
        self._pictures.pop(name, None)

    def png(self, name: str, *, max_age_s: float) -> bytes:
        """Return the reading as a PNG picture, encoded once per snapshot."""
        snapshot = self.read(name, max_age_s=max_age_s)
        cached = self._pictures.get(name)
        if cached is not None and cached[0] is snapshot:
            return cached[1]
        data = _encode_png(name, snapshot.stamped.value)
        self._pictures[name] = (snapshot, data)
        return data

    def npz(self, name: str, *, max_age_s: float) -> bytes:
        """Return the reading's array (`pixels` or `depth_m`) with its stamps in numpy's npz format.

        A range image also has `meta`, which describes the sensor as in `perception.range.recordings`, so it can be analysed.
        """
        stamped = self.read(name, max_age_s=max_age_s).stamped
        arrays = _arrays(name, stamped.value)
        if isinstance(stamped.value, RangeImage):
            arrays |= _sensor_of(self._connection().device(name).capabilities())
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays, host_time_s=stamped.host_time_s, sequence=stamped.sequence)
        return stream.getvalue()


def as_json(name: str, kind: DeviceKind, snapshot: ReceivedReading) -> dict[str, Any]:
    """Return a reading with its stamps as plain values; pictures are described, not listed."""
    stamped = snapshot.stamped
    return {
        "device": name,
        "kind": str(kind),
        "value": described(stamped.value),
        "host_time_s": stamped.host_time_s,
        "device_time_s": jsonable(stamped.device_time_s),
        "age_s": jsonable(snapshot.age_s),
        "sequence": stamped.sequence,
        "quality": str(stamped.quality),
        "cause": str(stamped.cause),
        "detail": stamped.detail,
    }


def described(value: Any) -> Any:
    """Return a value as plain JSON values; pictures are described, not listed."""
    if isinstance(value, Image):
        height, width = value.pixels.shape[:2]
        mean = float(value.pixels.mean())
        return {"width_px": width, "height_px": height, "mean_level": mean, "exposure_s": jsonable(value.exposure_s)}
    if isinstance(value, RangeImage):
        height, width = value.depth_m.shape
        seen = np.isfinite(value.depth_m)
        median = float(np.median(value.depth_m[seen])) if seen.any() else None
        return {"width": width, "height": height, "valid_ratio": float(seen.mean()), "median_depth_m": median}
    return jsonable(value)


def _arrays(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Image):
        return {"pixels": value.pixels, "exposure_s": value.exposure_s}
    if isinstance(value, RangeImage):
        return {"depth_m": value.depth_m}
    raise InvalidRequest(f"{name} gives no picture", hint="ask for format=json")


def _sensor_of(scanner: RangeScannerCapabilities) -> dict[str, str]:
    """Return the `meta` of a recording (unit and sensor); empty for a line of beams, which is not an image."""
    sensor: dict[str, Any]
    if scanner.projection == "pinhole":
        sensor = {"kind": "pinhole", "f": scanner.fx, "fy": scanner.fy, "cx": scanner.cx, "cy": scanner.cy}
    elif scanner.projection == "orthographic":
        sensor = {"kind": "ortho", "pitch": 1.0 / scanner.fx}
    else:
        return {}
    return {"meta": json.dumps({"unit": "m", "sensor": sensor | {"shape": [scanner.height, scanner.width]}})}


def _encode_png(name: str, value: Any) -> bytes:
    import cv2

    arrays = _arrays(name, value)
    pixels = arrays["pixels"] if "pixels" in arrays else _depth_picture(arrays["depth_m"])
    ordered = pixels[:, :, ::-1] if pixels.ndim == 3 else pixels
    done, data = cv2.imencode(".png", np.ascontiguousarray(ordered), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise InvalidRequest(f"the picture of {name} cannot be encoded", hint="ask for format=npz")
    return bytes(data.tobytes())


def _depth_picture(depth_m: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return a gray picture of a range image: near is bright, pixels without a range are black."""
    seen = np.isfinite(depth_m)
    if not seen.any():
        return np.zeros(depth_m.shape, np.uint8)
    near, far = np.percentile(depth_m[seen], [1.0, 99.0])
    bright = 255.0 - 215.0 * np.clip((depth_m - near) / max(far - near, 1e-6), 0.0, 1.0)
    return np.where(seen, bright, 0.0).astype(np.uint8)
