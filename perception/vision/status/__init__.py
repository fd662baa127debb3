"""Readers, one file per kind: each converts a rectified patch and the panel file's description into a reading.

The exported names are those that a package with a reader of its own needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from perception.vision.patch import Patch
    from perception.vision.reading import PatchReading
    from perception.vision.status.choice import choose, contrast_noise
    from perception.vision.status.reader import Reader

__all__ = ["Patch", "PatchReading", "Reader", "choose", "contrast_noise"]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
