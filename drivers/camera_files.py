"""Camera that plays a folder of pictures or a video file through the same interface as a live camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.cameras import LensOptions, Pixels, nominal, to_pixels
from drivers.kinds.file_player import FilePlayer, undamaged_png
from drivers.transport.options import read_options
from hal.clock import Deadline
from hal.devices import CameraCapabilities, DeviceKind, Image
from hal.errors import DeviceFault, DeviceUnavailable
from hal.readings import Stamped
from hal.registry import Context, takes

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")


class CameraFilesOptions(LensOptions):
    """Options of `files:camera`: `path` is a folder of pictures, in the order of their names, or a video."""

    path: Annotated[Path, Field(description="folder of pictures, read in the order of their names, or a video file")]
    rate_hz: Annotated[float, Field(gt=0, le=1000, description="pictures per second")] = 10.0
    is_colour: Annotated[bool, Field(description="whether the images are RGB; else they are grey")] = True
    repeat: Annotated[bool, Field(description="whether to begin again after the last picture")] = True
    exposure_s: Annotated[float, Field(gt=0, description="exposure time that the readings state")] = 0.01


class CameraFiles(FilePlayer[Image]):
    """Plays pictures, or the frames of a video, as a camera."""

    kind = DeviceKind.CAMERA

    def __init__(self, context: Context, options: CameraFilesOptions) -> None:
        super().__init__(context, options.path, rate_hz=options.rate_hz)
        self._options = options
        self._frames = self._open()
        first = self._load(0)
        self._shape = first.shape
        self._size = (first.shape[1], first.shape[0])

    def capabilities(self) -> CameraCapabilities:
        """Return the capabilities; the image size is that of the first picture, which all others must have."""
        width_px, height_px = self._size
        return CameraCapabilities(
            width_px=width_px,
            height_px=height_px,
            is_colour=self._options.is_colour,
            rate_hz=self._options.rate_hz,
            nominal=nominal(width_px, height_px, self._options),
        )

    def read_image(self, *, deadline: Deadline) -> Stamped[Image]:
        """Return the next picture, not before its period has elapsed.

        Raises:
            DeviceTimeout: the deadline ends before the period. DeviceUnavailable: there are no more pictures.
        """
        return self.play(deadline)

    def show(self, index: int, shown_s: float) -> None:
        """Load and publish one picture."""
        self.publish(Image(pixels=self._load(index), exposure_s=self._options.exposure_s), valid_s=shown_s)

    def _open(self) -> list[Path] | list[Pixels]:
        path = self._options.path
        if path.is_dir():
            pictures = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURES)
            if pictures:
                return pictures
            raise self._missing(f"folder {path} has no pictures", f"put {', '.join(PICTURES[:3])} files into it")
        if not path.exists():
            raise self._missing(f"{path} does not exist", "give a folder of pictures or a video")
        return self._read_video(path)

    def _read_video(self, path: Path) -> list[Pixels]:
        video, frames = cv2.VideoCapture(str(path)), []
        try:
            while (grabbed := video.read())[0]:
                frames.append(to_pixels(grabbed[1], is_colour=self._options.is_colour))
        finally:
            video.release()
        if not frames:
            raise self._missing(f"{path} cannot be read as a video", "give a folder of pictures or a video")
        return frames

    def _load(self, index: int) -> Pixels:
        if index >= len(self._frames) and not self._options.repeat:
            raise self._missing(
                f"all {len(self._frames)} pictures have been shown",
                "set repeat = true, or connect the camera again to begin with the first",
            )
        frame = self._frames[index % len(self._frames)]
        if isinstance(frame, Path):
            raw = _read(frame)
            if raw is None:
                self.errors += 1
                raise DeviceFault(
                    f"{self.name}: {frame} cannot be read as a picture", hint="remove or replace it", device=self.name
                )
            frame = to_pixels(raw, is_colour=self._options.is_colour)
        if index > 0 and frame.shape != self._shape:
            self.errors += 1
            height_px, width_px = frame.shape[:2]
            raise DeviceFault(
                f"{self.name}: picture {index} is {width_px}x{height_px}, the first {self._size[0]}x{self._size[1]}",
                hint="all pictures of one camera must have the same size",
                device=self.name,
            )
        return frame

    def _missing(self, what: str, hint: str) -> DeviceUnavailable:
        return DeviceUnavailable(f"{self.name}: {what}", hint=hint, device=self.name)


def _read(path: Path) -> NDArray[Any] | None:
    """Return the pixels as OpenCV gives them; None if the file is damaged or missing."""
    try:
        content = path.read_bytes()
        content = undamaged_png(content) if path.suffix.lower() == ".png" else content
    except (OSError, ValueError):
        return None
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None


@takes(CameraFilesOptions)
def connect(context: Context, options: dict[str, Any]) -> CameraFiles:
    """Entry point `files:camera`."""
    return CameraFiles(context, read_options(context, options, CameraFilesOptions))
