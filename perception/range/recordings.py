"""Range recordings in files (npz, npy, PNG and TIFF), decoded to metres, with their sensor.

An npz file has:
    depth    (H, W), floats or integer codes; `depth_m` in a reading saved by `panelwright devices read --save`.
    meta     JSON text with `unit` ("m" or "mm") and `sensor`: {"kind": "pinhole", "shape", "f", "fy", "cx", "cy"} or
             {"kind": "ortho", "shape", "pitch"}, with the pitch in the unit.
    K        instead of `meta`: fx, fy, cx, cy or the 3x3 matrix; depth is then in millimetres.
    u8       8-bit codes, used if there is no depth; decoded with `near` and `far` in `meta.u8` (codes 0 to 255).

An npy, PNG or TIFF file, and an npz file with `depth` alone, has only the image; a `Reading` supplies the rest.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.errors import InvalidRequest
from perception.range.sensor import OrthographicSensor, PinholeSensor, RangeSensorModel
from perception.range.window import Window, decode_scaled

SUFFIXES = (".npz", ".npy", ".png", ".tif", ".tiff")
UNITS_M = {"m": 1.0, "mm": 0.001}  # metres per unit
DEFAULT_CODE_M = 0.001  # metres per code, as is usual in 16-bit depth images
DEFAULT_FOCAL_PER_WIDTH = 0.9  # focal length per image width; structured-light cameras see about 58 degrees across
UNREADABLE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    EOFError,
    MemoryError,  # a header may claim any size
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How to read a recording: what its file does not say, or says wrongly.

    Attributes:
        scale_m: metres per unit of floats or per code of integers, instead of what the file says.
        near_m, far_m: depths of the 8-bit codes 0 and 255; both or neither are given.
        focal_px: fx and fy of a pinhole sensor.
        centre_px: its cx and cy; the middle of the image by default.
        pitch_m: pixel pitch of an orthographic sensor; excludes `focal_px`.
        codes: whether to read the 8-bit codes of an npz file even if it has depth.

    Raises:
        InvalidRequest: values that contradict each other or make no sense.
    """

    scale_m: float | None = None
    near_m: float | None = None
    far_m: float | None = None
    focal_px: tuple[float, float] | None = None
    centre_px: tuple[float, float] | None = None
    pitch_m: float | None = None
    codes: bool = False

    def __post_init__(self) -> None:
        if (self.near_m is None) != (self.far_m is None):
            raise InvalidRequest("a window has two ends", hint="give near and far together")
        if self.pitch_m is not None and (self.focal_px is not None or self.centre_px is not None):
            raise InvalidRequest(
                "a sensor is either orthographic or a pinhole", hint="give the pixel pitch, or focal lengths and centre"
            )
        if self.centre_px is not None and self.focal_px is None:
            raise InvalidRequest("an image centre without a focal length", hint="give the focal length too")
        if self.scale_m is not None and not (self.scale_m > 0 and np.isfinite(self.scale_m)):
            raise InvalidRequest(f"scale of {self.scale_m} m is not positive", hint="0.001 for millimetres")

    @property
    def window(self) -> Window | None:
        """The window of 8-bit codes; None if it is not given."""
        if self.near_m is None or self.far_m is None:
            return None
        return Window(near_m=self.near_m, far_m=self.far_m)

    def sensor(self, shape: tuple[int, int]) -> RangeSensorModel | None:
        """Return the given sensor model for an image of `shape` (H, W); None if none is given."""
        h, w = shape
        if self.pitch_m is not None:
            return OrthographicSensor(width_px=w, height_px=h, pixel_pitch_m=self.pitch_m)
        if self.focal_px is None:
            return None
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px or ((w - 1) / 2, (h - 1) / 2)
        return PinholeSensor(width_px=w, height_px=h, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)


AS_FILED = Reading()


def load_recording(path: Path, *, reading: Reading = AS_FILED) -> tuple[Array, RangeSensorModel]:
    """Return depth (H, W) in metres, with NaN for missing readings, and the sensor model of one recording.

    `reading`: what the file does not say.

    Raises:
        InvalidRequest: the file cannot be read as a recording; the message says why.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        raise InvalidRequest(f"{path} is a folder", hint="`panelwright batch range FOLDER` analyses all of one")
    if suffix not in SUFFIXES:
        raise InvalidRequest(f"{path.name} is of no known kind", hint=f"recordings end in {', '.join(SUFFIXES)}")
    try:
        depth, filed = _load_npz(path, reading) if suffix == ".npz" else (_decoded(_image(path), reading), None)
    except UNREADABLE as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        missing = isinstance(error, OSError)
        hint = "check the path" if missing else "npz with depth and meta, npy, 16-bit PNG or TIFF"
        raise InvalidRequest(f"{path.name} is no range recording: {reason}", hint=hint) from error
    if depth.ndim != 2:
        raise InvalidRequest(f"{path.name} holds shape {depth.shape}", hint="one (H, W) depth image a file")
    shape = (depth.shape[0], depth.shape[1])
    return depth, reading.sensor(shape) or filed or assumed_sensor(shape)


def assumptions(path: Path, reading: Reading) -> tuple[str, ...]:
    """Return a sentence for each assumption that is made if `path` is loaded with `reading`."""
    out = []
    if _is_bare(path) and reading.sensor((1, 1)) is None:
        out.append("no sensor is given: a pinhole of 58 degrees across is assumed, so sizes may be off by its error")
    if path.suffix.lower() == ".png" and reading.scale_m is None and reading.window is None:
        out.append("no scale is given: a code is taken for 1 mm, 0 for no reading")
    return tuple(out)


def _is_bare(path: Path) -> bool:
    """Return whether the file holds an image and nothing about its sensor."""
    if path.suffix.lower() != ".npz":
        return True
    with np.load(path, allow_pickle=False) as data:
        return not {"meta", "K"} & set(data.files)


def assumed_sensor(shape: tuple[int, int]) -> PinholeSensor:
    """Return a pinhole that sees 58 degrees across, for an image of `shape` (H, W) with an unknown sensor."""
    h, w = shape
    focal = DEFAULT_FOCAL_PER_WIDTH * w
    return PinholeSensor(width_px=w, height_px=h, fx_px=focal, fy_px=focal, cx_px=(w - 1) / 2, cy_px=(h - 1) / 2)


def _image(path: Path) -> NDArray[Any]:
    """Return the image of an npy, PNG or TIFF file."""
    if path.suffix.lower() == ".npy":
        with path.open("rb") as file:
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    raw = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if raw is None:
        raise ValueError("no picture, or not all of it is there")
    if raw.ndim != 2:
        raise ValueError(f"a picture of {raw.shape[2]} channels, and depth has one")
    return np.asarray(raw)


def _decoded(raw: NDArray[Any], reading: Reading) -> Array:
    """Convert a bare image to metres: floats are metres, 16-bit codes millimetres, 8-bit codes need their window."""
    if raw.dtype.kind == "f":
        return np.asarray(raw, float) * (reading.scale_m or 1.0)
    if reading.window is not None:
        return reading.window.decode(raw)
    if raw.dtype.itemsize == 1 and reading.scale_m is None:
        raise InvalidRequest(
            "8-bit codes say nothing without their window", hint="give near and far in metres, or the scale of a code"
        )
    return decode_scaled(raw, reading.scale_m or DEFAULT_CODE_M)


def _load_npz(path: Path, reading: Reading) -> tuple[Array, RangeSensorModel | None]:
    """Load an npz file, with its sensor if it holds one."""
    if path.stat().st_size and not zipfile.is_zipfile(path):
        raise ValueError("it is no zip archive, or not all of it is there")
    with np.load(path, allow_pickle=False) as data:
        if not {"depth", "depth_m", "u8"} & set(data.files):
            raise ValueError(f"it holds {', '.join(data.files) or 'nothing'}, and neither depth nor u8")
        if "depth_m" in data.files:
            return _decoded(data["depth_m"], reading), _sensor_of_reading(data)
        if not {"meta", "K"} & set(data.files) and "depth" in data.files:
            return _decoded(data["depth"], reading), None
        meta = json.loads(str(data["meta"])) if "meta" in data.files else _meta_of_intrinsics(data)
        unit = UNITS_M[meta.get("unit", "mm")]
        depth = _depth(data, meta, unit, reading)
    filed = sensor_from_meta(meta["sensor"], unit) if "sensor" in meta else None
    return depth, filed


def _sensor_of_reading(data: Any) -> RangeSensorModel | None:
    """Return the sensor in the metadata of a saved reading; None for a sweep of beams, which has none."""
    return sensor_from_meta(json.loads(str(data["meta"]))["sensor"], 1.0) if "meta" in data.files else None


def _depth(data: Any, meta: dict[str, Any], unit: float, reading: Reading) -> Array:
    """Return the depth in metres of an npz file with metadata, from `depth` or from the 8-bit codes."""
    if "depth" in data.files and not reading.codes:
        raw = data["depth"]
        scale = reading.scale_m or unit
        return np.asarray(raw, float) * scale if raw.dtype.kind == "f" else decode_scaled(raw, scale)
    if reading.window is not None:
        return reading.window.decode(data["u8"])
    u8 = meta["u8"]
    return Window(near_m=u8["near"] * unit, far_m=u8["far"] * unit).decode(data["u8"])


def _meta_of_intrinsics(data: Any) -> dict[str, Any]:
    """Return metadata in the form of `meta` for an npz file that has `K`, or neither."""
    if "K" not in data.files:
        return {"unit": "mm"}
    K = np.asarray(data["K"], float)
    fx, fy, cx, cy = (K[0, 0], K[1, 1], K[0, 2], K[1, 2]) if K.shape == (3, 3) else (float(v) for v in K)
    shape = list(data["depth"].shape)
    return {"unit": "mm", "sensor": {"kind": "pinhole", "shape": shape, "f": fx, "fy": fy, "cx": cx, "cy": cy}}


def sensor_from_meta(meta: dict[str, Any], unit_m: float) -> RangeSensorModel:
    """Return the sensor model of a recording's `meta.sensor`; `unit_m` is metres per unit of `pitch`."""
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
