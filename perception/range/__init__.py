"""Analysis of range images: surfaces with covariance, and component models found among them (paper, Section III)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from perception.range.analysis import RangeScene, analyse
    from perception.range.batch import batch_range, recordings_in
    from perception.range.batch_results import BatchResult, KeptResults
    from perception.range.cap_height import measure_cap
    from perception.range.matching.cross_check import check_place, outline_px, states_agree
    from perception.range.matching.match import Match, match_models
    from perception.range.matching.models import load_models
    from perception.range.matching.panel_objects import PanelScan, Sighting, find_objects
    from perception.range.obstacles import find_obstacles
    from perception.range.plane import PlaneFit, fit_plane_near
    from perception.range.primitives import Cone, Cylinder, Ellipsoid, Plane, Sphere, Surface, SurfaceType
    from perception.range.recordings import Reading, assumptions, load_recording
    from perception.range.render import MARK, picture, scene_json, write_ply, write_png
    from perception.range.sensor import OrthographicSensor, PinholeSensor
    from perception.range.sweep import SweepPass, SweptErrors, image_from_sweep
    from perception.range.warm import warm_up

__all__ = [
    "MARK",
    "BatchResult",
    "Cone",
    "Cylinder",
    "Ellipsoid",
    "KeptResults",
    "Match",
    "OrthographicSensor",
    "PanelScan",
    "PinholeSensor",
    "Plane",
    "PlaneFit",
    "RangeScene",
    "Reading",
    "Sighting",
    "Sphere",
    "Surface",
    "SurfaceType",
    "SweepPass",
    "SweptErrors",
    "analyse",
    "assumptions",
    "batch_range",
    "check_place",
    "find_objects",
    "find_obstacles",
    "fit_plane_near",
    "image_from_sweep",
    "load_models",
    "load_recording",
    "match_models",
    "measure_cap",
    "outline_px",
    "picture",
    "recordings_in",
    "scene_json",
    "states_agree",
    "warm_up",
    "write_ply",
    "write_png",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
