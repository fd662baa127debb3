"""Range scanner that plays a folder of depth pictures, as recorders of RGB-D and ToF cameras write them.

The pictures are `.png` with 16 bits (`unit_m` per count), or `.npy` or the first array of `.npz` in metres; 0 means no
reading.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal
from zipfile import BadZipFile

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.file_player import FilePlayer, undamaged_png
from drivers.transport.options import read_options
from hal.arrays import Array
from hal.clock import Deadline
from hal.devices import DeviceKind, RangeImage, RangeScannerCapabilities
from hal.errors import DeviceFault, DeviceUnavailable
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from hal.strict import Strict

SUFFIXES = (".png", ".npy", ".npz")


class DepthCameraOptions(Strict):
    """Options of `files:depth`; the lens is that of the recording camera's data sheet."""

    path: Annotated[
        Path, Field(description="folder of 16-bit PNG, `.npy` or `.npz` depth images, read in the order of their names")
    ]
    fx: Annotated[
        float, Field(gt=0, description="focal length along the rows, px; for an orthographic projection px per metre")
    ]
    fy: Annotated[float, Field(gt=0, description="focal length along the columns, as `fx`")]
    cx: Annotated[float, Field(description="column of the principal point, px")]
    cy: Annotated[float, Field(description="row of the principal point, px")]
    projection: Annotated[
        Literal["pinhole", "orthographic"], Field(description="projection of the recording camera")
    ] = "pinhole"
    unit_m: Annotated[float, Field(gt=0, description="length of one step of the values in integer images")] = 0.001
    min_range_m: Annotated[float, Field(ge=0, description="a smaller depth has no value")] = 0.1
    max_range_m: Annotated[float, Field(gt=0, description="a larger depth has no value")] = 10.0
    sigma_m: Annotated[float, Field(gt=0, description="noise of one pixel, one sigma")] = 0.003
    rate_hz: Annotated[float, Field(gt=0, le=1000, description="images per second")] = 10.0


class DepthCamera(FilePlayer[RangeImage]):
    """Plays depth pictures in an endless loop, one per period."""

    kind = DeviceKind.RANGE_SCANNER

    def __init__(self, context: Context, options: DepthCameraOptions) -> None:
        super().__init__(context, options.path, rate_hz=options.rate_hz)
        self._options = options
        folder = options.path
        self._files = sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES) if folder.is_dir() else []
        if not self._files:
            raise DeviceUnavailable(
                f"{context.name}: {folder} holds no depth pictures",
                hint=f"give a folder with {', '.join(SUFFIXES)} files",
                device=context.name,
            )
        self._shape = self._load(0).shape

    def capabilities(self) -> RangeScannerCapabilities:
        """Return the size of the first picture, with lens and limits from the options."""
        o = self._options
        return RangeScannerCapabilities(
            projection=o.projection,
            width=self._shape[1],
            height=self._shape[0],
            fx=o.fx,
            fy=o.fy,
            cx=o.cx,
            cy=o.cy,
            min_range_m=o.min_range_m,
            max_range_m=o.max_range_m,
            sigma_m=o.sigma_m,
            rate_hz=o.rate_hz,
        )

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """Return the next picture, not before its period has elapsed."""
        return self.play(deadline)

    def show(self, index: int, shown_s: float) -> None:
        """Load and publish one depth picture."""
        depth_m = self._load(index)
        is_seen = bool(np.isfinite(depth_m).any())
        self.publish(
            RangeImage(depth_m=depth_m),
            valid_s=shown_s,
            quality=Quality.VALID if is_seen else Quality.INVALID,
            cause=Cause.NONE if is_seen else Cause.OUT_OF_RANGE,
        )

    def _load(self, index: int) -> NDArray[np.float32]:
        path, o = self._files[index % len(self._files)], self._options
        try:
            depth_m = _read(path, o.unit_m)
        except (OSError, ValueError, IndexError, EOFError, BadZipFile) as error:
            raise self._fault(f"{path} is not a depth picture: {error}") from error
        if depth_m.ndim != 2 or (index > 0 and depth_m.shape != self._shape):
            raise self._fault(f"{path} has shape {depth_m.shape}, not (rows, columns) as the first picture")
        is_seen = (depth_m >= o.min_range_m) & (depth_m <= o.max_range_m)
        return np.where(is_seen, depth_m, np.nan).astype(np.float32)

    def _fault(self, what: str) -> DeviceFault:
        self.errors += 1
        return DeviceFault(f"{self.name}: {what}", hint="remove or replace it", device=self.name)


def _read(path: Path, unit_m: float) -> Array:
    if path.suffix == ".png":
        raw = cv2.imdecode(np.frombuffer(undamaged_png(path.read_bytes()), np.uint8), cv2.IMREAD_UNCHANGED)
        if raw is None or raw.dtype != np.uint16:
            raise ValueError("not a PNG of 16 bits")
        return np.asarray(raw, dtype=np.float64) * unit_m
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return np.asarray(loaded, dtype=np.float64)
    with loaded:
        return np.asarray(loaded[loaded.files[0]], dtype=np.float64)


@takes(DepthCameraOptions)
def connect(context: Context, options: dict[str, Any]) -> DepthCamera:
    """Entry point `files:depth`."""
    return DepthCamera(context, read_options(context, options, DepthCameraOptions))
