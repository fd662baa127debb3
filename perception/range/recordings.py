"""Range recordings on disk: npz and 16-bit PNG, decoded to metres with their sensor.

npz: `depth` (float or integer) and JSON text `meta` with `unit` ("m" or "mm"), `sensor` ({"kind": "pinhole", "shape",
"f", "fy", "cx", "cy"} or {"kind": "ortho", "shape", "pitch"}; pitch in the unit), or `K` = fx, fy, cx, cy with depth in
millimetres. Where `depth` is absent, 8-bit codes `u8` are decoded with `meta.u8` (`near`, `far`, 0 near .. 255 far).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.errors import InvalidRequest
from perception.range.sensor import OrthographicSensor, PinholeSensor, RangeSensorModel
from perception.range.window import Window, decode_scaled

Array = NDArray[np.float64]

UNITS_M = {"m": 1.0, "mm": 0.001}
DEFAULT_FOCAL_PER_WIDTH = 0.9  # structured-light cameras see about 58 degrees across


def load_recording(
    path: Path, *, sensor: RangeSensorModel | None = None, png_scale_m: float = 0.001, codes: bool = False
) -> tuple[Array, RangeSensorModel]:
    """Depth (H, W) in metres with NaN, and the sensor model, of one recording.

    Args:
        sensor: used instead of what the file says; needed for PNG (else a 58 degree pinhole is assumed).
        png_scale_m: metres a code of a PNG; code 0 is no reading.
        codes: read the 8-bit codes even where the file has depth.

    Raises:
        InvalidRequest: the file cannot be read as a recording; the message says why.
    """
    try:
        return _load_png(path, sensor, png_scale_m) if path.suffix == ".png" else _load_npz(path, sensor, codes)
    except (OSError, ValueError, KeyError) as error:
        raise InvalidRequest(
            f"{path.name} is no range recording: {error}", hint="npz with depth and meta, or 16-bit PNG"
        ) from error


def _load_png(path: Path, sensor: RangeSensorModel | None, scale_m: float) -> tuple[Array, RangeSensorModel]:
    raw = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.ndim != 2:
        raise ValueError("not a single-channel PNG")
    h, w = raw.shape
    focal = DEFAULT_FOCAL_PER_WIDTH * w
    assumed = PinholeSensor(width_px=w, height_px=h, fx_px=focal, fy_px=focal, cx_px=(w - 1) / 2, cy_px=(h - 1) / 2)
    return decode_scaled(raw, scale_m), sensor or assumed


def _load_npz(path: Path, sensor: RangeSensorModel | None, codes: bool) -> tuple[Array, RangeSensorModel]:
    with np.load(path, allow_pickle=False) as data:
        meta = json.loads(str(data["meta"])) if "meta" in data.files else _meta_of_intrinsics(data)
        unit = UNITS_M[meta.get("unit", "mm")]
        depth = _depth(data, meta, unit, codes)
    return depth, sensor or sensor_from_meta(meta["sensor"], unit)


def _depth(data: Any, meta: dict[str, Any], unit: float, codes: bool) -> Array:
    if "depth" in data.files and not codes:
        return np.asarray(data["depth"], float) * unit
    u8 = meta["u8"]
    return Window(near_m=u8["near"] * unit, far_m=u8["far"] * unit).decode(data["u8"])


def _meta_of_intrinsics(data: Any) -> dict[str, Any]:
    fx, fy, cx, cy = (float(v) for v in data["K"])
    shape = list(data["depth"].shape)
    return {"unit": "mm", "sensor": {"kind": "pinhole", "shape": shape, "f": fx, "fy": fy, "cx": cx, "cy": cy}}


def sensor_from_meta(meta: dict[str, Any], unit_m: float) -> RangeSensorModel:
    """The sensor model of a recording's `meta.sensor`; `unit_m` metres a unit of `pitch`."""
    h, w = (int(n) for n in meta["shape"])
    if meta["kind"] == "ortho":
        return OrthographicSensor(width_px=w, height_px=h, pixel_pitch_m=float(meta["pitch"]) * unit_m)
    if meta["kind"] != "pinhole":
        raise ValueError(f"unknown sensor kind {meta['kind']!r}")
    f = float(meta["f"])
    return PinholeSensor(
        width_px=w,
        height_px=h,
        fx_px=f,
        fy_px=float(meta.get("fy", f)),
        cx_px=float(meta["cx"]),
        cy_px=float(meta["cy"]),
    )
