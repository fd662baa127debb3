"""The panel's four lights in a pair of images, off and on, and the pose that they give.

`alignment` lays the two images onto each other, `find` grows the blobs of the difference, `core` finds the lamp in
each, `assign` picks the four that the taught quadrangle allows (`search`), `panel_finder` joins them.
"""

from perception.vision.lights.alignment import CameraMoved
from perception.vision.lights.assign import UPRIGHT, AssignedLights, LightMissing, WrongLamp, assign_lights
from perception.vision.lights.find import LightBlobs, find_lights, gray_of
from perception.vision.lights.panel_finder import FoundPanel, PanelPrior, find_panel, find_panel_lights, warm_up

__all__ = [
    "UPRIGHT", "AssignedLights", "CameraMoved", "FoundPanel", "LightBlobs", "LightMissing", "PanelPrior", "WrongLamp",
    "assign_lights", "find_lights", "find_panel", "find_panel_lights", "gray_of", "warm_up",
]  # fmt: skip
