"""The panel's four lights in a pair of images, off and on, and the pose that they give.

`registration` lays the two images onto each other, `find` grows the blobs of the difference, `core` finds the lamp in
each, `assign` picks the four that the taught quadrangle allows (`search`), `panel_view` joins them.
"""

from perception.vision.lights.alignment import CameraMoved
from perception.vision.lights.assign import UPRIGHT, AssignedLights, LightMissing, WrongLamp, assign_lights
from perception.vision.lights.find import LightBlobs, find_lights, gray_of
from perception.vision.lights.panel_view import PanelView, panel_pose, warm_up

__all__ = [
    "UPRIGHT", "AssignedLights", "CameraMoved", "LightBlobs", "LightMissing", "PanelView", "WrongLamp", "assign_lights",
    "find_lights", "gray_of", "panel_pose", "warm_up",
]  # fmt: skip
