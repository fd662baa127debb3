"""Reader of emergency-stop mushroom buttons, which stay in when pressed."""

from __future__ import annotations

from hal.panel import Mushroom
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading
from perception.vision.status.button import read_cap
from perception.vision.status.reader import Reader


def read_mushroom(patch: Patch, spec: Mushroom) -> PatchReading:
    """Return the state of an emergency-stop button. `patch` may show any plane near the cap."""
    return read_cap(patch, spec, foot_m=None)  # the head moves as a whole


READER = Reader[Mushroom](read=read_mushroom)
