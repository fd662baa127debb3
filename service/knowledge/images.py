"""Stores images that are uploaded and checked once and then named in requests."""

from __future__ import annotations

import hashlib
import os
import re
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hal.atomic_write import flush_folder
from hal.errors import InvalidRequest
from service.errors import NoSuchTask, NotPossibleNow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FOLDER = "images"
MAX_IMAGE_BYTES = 32_000_000  # a 40 megapixel photograph has 10 to 20 MB
MAX_IMAGES = 500
MAX_STORE_BYTES = 2_000_000_000
PLAIN_ID = re.compile(r"[0-9a-f]{24}")
SUFFIXES = {b"\x89PNG": ".png", b"\xff\xd8": ".jpg", b"BM": ".bmp"}
MEDIA = {".png": "image/png", ".jpg": "image/jpeg", ".bmp": "image/bmp"}


class NoSuchImage(NoSuchTask):
    """There is no stored image with that id."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredImage:
    """A stored image; its id is derived from its content, so the same image always has the same id."""

    id: str
    path: Path
    width_px: int
    height_px: int
    size_bytes: int
    stored_s: float

    @property
    def media_type(self) -> str:
        """The media type for HTTP."""
        return MEDIA[self.path.suffix]


class ImageStore:
    """Stores images in `runs_dir/images`, one file each."""

    _lock = threading.Lock()  # shared by all stores of this process, which may use one folder

    def __init__(self, runs_dir: Path) -> None:
        self._folder = runs_dir / FOLDER

    def add(self, data: bytes) -> StoredImage:
        """Check and store an image.

        Raises:
            InvalidRequest: the data are not an image, or it is damaged, deeper than 8 bits, too small or too large.
            NotPossibleNow: the store is full.
        """
        from perception.vision import check_image, decode

        if len(data) > MAX_IMAGE_BYTES:
            raise InvalidRequest(f"the image has {len(data)} bytes", hint=f"send at most {MAX_IMAGE_BYTES}")
        check_image(decode(data))
        image_id = hashlib.blake2b(data, digest_size=12).hexdigest()
        suffix = next(suffix for magic, suffix in SUFFIXES.items() if data.startswith(magic))
        with self._lock:
            self._folder.mkdir(parents=True, exist_ok=True)
            kept = list(self._files())
            if not any(path.stem == image_id for path in kept):
                if len(kept) >= MAX_IMAGES or sum(path.stat().st_size for path in kept) > MAX_STORE_BYTES:
                    raise NotPossibleNow(
                        f"{len(kept)} images are stored already", hint="DELETE /v1/images/{image_id} of some first"
                    )
                partial = self._folder / f"{image_id}.part"
                try:
                    partial.write_bytes(data)
                    with partial.open("rb") as file:
                        os.fsync(file.fileno())
                    partial.rename(self._folder / f"{image_id}{suffix}")
                    flush_folder(self._folder)
                finally:
                    partial.unlink(missing_ok=True)  # incomplete file after a full disk
        return self.get(image_id)

    def get(self, image_id: str) -> StoredImage:
        """Return the stored image with that id.

        Raises:
            NoSuchImage: there is none.
        """
        if PLAIN_ID.fullmatch(image_id):
            for path in self._files():
                if path.stem == image_id:
                    return _stored(path)
        raise NoSuchImage("there is no stored image of that id", hint="POST /v1/images stores one, GET lists them")

    def pixels(self, image_id: str) -> NDArray[np.uint8]:
        """Return an image's pixels, gray (H, W) or RGB (H, W, 3).

        Raises:
            NoSuchImage: there is none.
        """
        from perception.vision import decode

        return decode(self.get(image_id).path.read_bytes())

    def all(self) -> list[StoredImage]:
        """Return all stored images, newest first."""
        return sorted((_stored(path) for path in self._files()), key=lambda image: image.stored_s, reverse=True)

    def remove(self, image_id: str) -> None:
        """Delete an image.

        Raises:
            NoSuchImage: there is none.
        """
        self.get(image_id).path.unlink(missing_ok=True)

    def _files(self) -> list[Path]:
        if not self._folder.is_dir():
            return []
        return [path for path in self._folder.iterdir() if path.suffix in MEDIA and PLAIN_ID.fullmatch(path.stem)]


def _stored(path: Path) -> StoredImage:
    from PIL import Image as Pillow

    status = path.stat()
    with Pillow.open(path) as picture:  # reads the header only
        width, height = picture.size
        if picture.getexif().get(0x0112, 1) >= 5:  # EXIF orientations 5 to 8 swap width and height
            width, height = height, width
    return StoredImage(
        id=path.stem, path=path, width_px=width, height_px=height, size_bytes=status.st_size, stored_s=status.st_mtime
    )
