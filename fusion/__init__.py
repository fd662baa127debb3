"""Facts to a pose: nine kinds of sensing, one squared distance, one robust answer with its covariance (paper IV).

    from fusion import fuse, features, sensing
    touched = sensing.touch(features.plane((0.4, 0.2, 0), (0, 0, 1)), base_from_finger, sigma_m=0.0003)
    answer = fuse([touched, ...], prior=pose_from_the_lights)

`warm_up` compiles, or loads, the fast loops; call it once when a process starts.
"""

from __future__ import annotations

from fusion.features import Feature, Kind
from fusion.measurement import Measurement, SensingClass
from fusion.robust import FusedPose, fuse
from fusion.warm import warm_up

__all__ = ["Feature", "FusedPose", "Kind", "Measurement", "SensingClass", "fuse", "warm_up"]
