"""Detection of the panel's four lights in a pair of images, off and on, and the pose that follows from them.

`alignment` registers the two images, `find` extracts the blobs of the difference, `core` finds the lamp in each,
`assign` selects the four that match the taught quadrangle (`search`), `panel_finder` combines these steps.
"""

from perception.vision.lights.alignment import CameraMoved
from perception.vision.lights.assign import UPRIGHT, AssignedLights, LightMissing, WrongLamp, assign_lights
from perception.vision.lights.find import LightBlobs, find_lights, gray_of
from perception.vision.lights.panel_finder import FoundPanel, PanelPrior, find_panel, find_panel_lights, warm_up

__all__ = [
    "UPRIGHT", "AssignedLights", "CameraMoved", "FoundPanel", "LightBlobs", "LightMissing", "PanelPrior", "WrongLamp",
    "assign_lights", "find_lights", "find_panel", "find_panel_lights", "gray_of", "warm_up",
]  # fmt: skip
