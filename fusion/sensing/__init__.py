"""From what a sensor says to a measurement with its distance function (paper section IV-B, eq 13).

Every function takes the sensor's pose as an `UncertainPose`, so that what is not known about the arm or the mounting enters C
and M, and propagates covariances to first order. Which of the nine classes comes out depends on the feature given: a touched
point on an edge is point-line, on a face point-plane. Pixels are undistorted first (perception's camera model); camera axes are
x right, y down, z forward. Measurements from one sensor pose share its error; the fusion takes them as independent.
"""

from __future__ import annotations

from fusion.sensing.camera import Pinhole, View, image_line, pixel
from fusion.sensing.contact import proximity, range_plane, range_point, touch
from fusion.sensing.two_views import light_stripe, stereo_line, stereo_point

__all__ = [
    "Pinhole", "View", "image_line", "light_stripe", "pixel", "proximity", "range_plane", "range_point", "stereo_line",
    "stereo_point", "touch",
]  # fmt: skip
