"""Turns sensor readings into measurements with their distance functions (paper section IV-B, eq 13).

Every function takes the sensor's pose as an `UncertainPose`, so that the uncertainty of arm and mounting enters C and
M, and propagates covariances to first order. The class depends on the feature given: a touched point on an edge is
point-line, on a face point-plane. Pixels are undistorted first (perception's camera model); camera axes are x right, y
down, z forward. Measurements from one sensor pose share its error; fusion takes them as independent.
"""

from __future__ import annotations

from fusion.sensing.camera import Pinhole, image_line, pixel
from fusion.sensing.contact import proximity, range_plane, range_point, touch

__all__ = [
    "Pinhole",
    "image_line",
    "pixel",
    "proximity",
    "range_plane",
    "range_point",
    "touch",
]
