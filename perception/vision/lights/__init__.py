"""Detection of the panel's four lights in a pair of images, with lights off and on, and of the panel's pose from them.

`alignment` registers the two images, `find` extracts the blobs of the difference, `core` separates the lamp in each
from its glow, `assign` selects the four that match the taught quadrangle (`search`), and `panel_finder` combines these
steps.
"""

from perception.vision.lights.alignment import CameraMoved
from perception.vision.lights.assign import UPRIGHT, AssignedLights, LightMissing, WrongLamp, assign_lights
from perception.vision.lights.find import LightBlobs, find_lights, gray_of
from perception.vision.lights.panel_finder import FoundPanel, PanelPrior, find_panel, find_panel_lights, warm_up

__all__ = [
    "UPRIGHT", "AssignedLights", "CameraMoved", "FoundPanel", "LightBlobs", "LightMissing", "PanelPrior", "WrongLamp",
    "assign_lights", "find_lights", "find_panel", "find_panel_lights", "gray_of", "warm_up",
]  # fmt: skip
