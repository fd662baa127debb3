"""Fuses measurements of nine sensing classes into one robust pose (paper, section IV).

    from fusion import fuse, features, sensing
    touched = sensing.touch(features.plane((0.4, 0.2, 0), (0, 0, 1)), base_from_finger, sigma_m=0.0003)
    answer = fuse([touched, ...], prior=pose_from_the_lights)

`warm_up` compiles, or loads, the fast loops; call it once when a process starts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from fusion.errors import Contradiction
    from fusion.features import Feature, Kind, unit
    from fusion.measurement import Measurement, SensingClass
    from fusion.observations import (
        Observation,
        PixelObservation,
        PlaneObservation,
        ProximityObservation,
        TouchObservation,
    )
    from fusion.planning import PoseTolerance, SensingChoice, TouchPlan
    from fusion.robust import FusedPose, ShapeEstimate, fuse
    from fusion.shapes import Box, Cylinder, FeatureSet, MovingPart, Shape
    from fusion.shared_errors import FusedObservations, error_budget, fuse_observations
    from fusion.solve import solve_from_many
    from fusion.triangulation import depth_before, triangulate, with_common_errors
    from fusion.warm import warm_up

__all__ = [
    "Box",
    "Contradiction",
    "Cylinder",
    "Feature",
    "FeatureSet",
    "FusedObservations",
    "FusedPose",
    "Kind",
    "Measurement",
    "MovingPart",
    "Observation",
    "PixelObservation",
    "PlaneObservation",
    "PoseTolerance",
    "ProximityObservation",
    "SensingChoice",
    "SensingClass",
    "Shape",
    "ShapeEstimate",
    "TouchObservation",
    "TouchPlan",
    "depth_before",
    "error_budget",
    "fuse",
    "fuse_observations",
    "solve_from_many",
    "triangulate",
    "unit",
    "warm_up",
    "with_common_errors",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
