"""Finding the objects of a panel file by their surfaces in a range image, each near its expected position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.geometry import UncertainPose, compose, point_covariance
from hal.panel import Panel, PanelObject, Relief
from perception.range.analysis import RangeScene
from perception.range.matching.match import Match, match_models
from perception.range.matching.models import ComponentModel, models_from
from perception.range.primitives import Surface

NEAR_M = 0.02  # largest accepted distance from the expected position; three sigmas of the panel pose are added
LEAST_PIXELS = 20  # over an object's footprint; with fewer the object is not in view


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """What one range image shows of an object of the panel file.

    Attributes:
        match, base_from_object: None if the object was not found; `why` then gives the reason.
        off_m: distance of the found position from the one that the panel file and the estimated panel pose predict.
        state: how far a mushroom is pressed in (m, 0 to -travel), or a wheel's angle clockwise (rad, modulo one spoke).
    """

    panel_object: PanelObject
    match: Match | None = None
    base_from_object: UncertainPose | None = None
    off_m: float | None = None
    state: float | None = None
    why: str = ""


def models_of(panel: Panel) -> dict[str, ComponentModel]:
    """Return the component model of each object of the panel file that has a relief, by the object's name."""
    tables = {one.name: one.relief.table() for one in panel.objects if one.relief is not None}
    models = models_from({"model": tables}, where=f"panel {panel.name}") if tables else ()
    return {model.name: model for model in models}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelScan:
    """An analysed range image of a panel.

    Attributes:
        depth_m: (H, W) the image.
        plate: the plane that the panel's objects stand on, in the sensor's frame.
        base_from_panel: estimated pose of the panel; it tells two objects of the same kind apart.
    """

    scene: RangeScene
    depth_m: Array
    base_from_sensor: UncertainPose
    plate: Surface
    base_from_panel: UncertainPose


def find_objects(panel: Panel, view: PanelScan) -> list[Sighting]:
    """Search a range image for each object of a panel file that has a relief, near its expected position."""
    reliefs = {one.name: one.relief for one in panel.objects if one.relief is not None}
    if not reliefs:
        return []
    models = models_of(panel)
    panel_from_sensor = view.base_from_panel.parent_from_child.inv() * view.base_from_sensor.parent_from_child
    points = panel_from_sensor.apply(view.scene.sensor.points(view.depth_m).reshape(-1, 3))
    points = points.reshape(*view.depth_m.shape, 3)
    return [_sighting(panel.object(name), relief, models[name], view, points) for name, relief in reliefs.items()]


def _sighting(
    panel_object: PanelObject, relief: Relief, model: ComponentModel, view: PanelScan, points: Array
) -> Sighting:
    """Search for one object. For speed, only those of `points` (H, W, 3; panel frame) that lie near it are matched."""
    away = np.abs(points[..., :2] - panel_object.position_m).max(axis=-1)
    half = max(panel_object.half_footprint_m)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(point_covariance(view.base_from_panel, panel_object.point_m))[-1]))
    reach_m = NEAR_M + 3.0 * sigma_m
    if np.count_nonzero(away < half + 3.0 * sigma_m) < LEAST_PIXELS:
        return Sighting(panel_object=panel_object, why="not in the scanner's view")
    near = np.where(away < half + relief.height_m + reach_m, view.depth_m, np.nan)
    expected = view.base_from_panel.parent_from_child.apply([*panel_object.position_m, 0.0])
    found = []
    for match in match_models(view.scene, near, (model,), panel=view.plate):
        pose = compose(view.base_from_sensor, match.sensor_from_object)
        found.append((float(np.linalg.norm(pose.parent_from_child.translation - expected)), pose, match))
    if not found:
        return Sighting(panel_object=panel_object, why="no surfaces like its own near its place")
    off_m, pose, match = min(found, key=lambda f: f[0])
    if off_m > reach_m:
        return Sighting(
            panel_object=panel_object, why=f"the nearest like it stands {1e3 * off_m:.0f} mm from its place"
        )
    state = _state(relief, match, view.base_from_panel.parent_from_child.inv() * pose.parent_from_child)
    return Sighting(panel_object=panel_object, match=match, base_from_object=pose, off_m=off_m, state=state)


def _state(relief: Relief, match: Match, panel_from_object: RigidTransform) -> float | None:
    """Return the state of the object's moving part as `Sighting.state` defines it."""
    if relief.motion == "slide":
        return match.state
    x, y, _ = panel_from_object.rotation.apply([1.0, 0.0, 0.0])
    return float(-np.arctan2(y, x) % (2.0 * np.pi / relief.turns))
