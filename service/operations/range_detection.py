"""Objects of the panel file found by their surfaces in a range image: the emergency mushroom and the valve wheel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import Unsupported
from hal.geometry import UncertainPose, compose, point_covariance
from hal.panel import Panel, PanelObject, Relief
from perception.range import (
    ComponentModel,
    Match,
    PinholeSensor,
    RangeScene,
    Surface,
    analyse,
    match_models,
    models_from,
)
from service.operations.acquisition import Scan
from service.report.surfaces import Mark

NEAR_M = 0.02  # a match further from where the file has its object is another thing; three sigmas of the belief beside
LEAST_PIXELS = 20  # over an object's footprint; with fewer it is not in view
OUTLINE_POINTS = 48


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """What one range image shows of an object of the panel file.

    Attributes:
        match, base_from_object: None when it was not found; `why` says so then.
        off_m: distance between where it was found and where the panel file and the believed pose have it.
        state: how far a mushroom is pressed in (m, 0 to -travel), or a wheel's angle clockwise (rad, modulo one spoke).
    """

    panel_object: PanelObject
    match: Match | None = None
    base_from_object: UncertainPose | None = None
    off_m: float | None = None
    state: float | None = None
    why: str = ""


def surfaces_in(image: Scan) -> RangeScene:
    """The range image analysed.

    Raises:
        Unsupported: a scanner that is no pinhole.
        InvalidRequest, NotFound: see `analyse`.
    """
    c = image.capabilities
    if c.projection != "pinhole":
        raise Unsupported(f"{image.scanner} has {c.projection} projection", hint="use a pinhole range scanner")
    sensor = PinholeSensor(width_px=c.width, height_px=c.height, fx_px=c.fx, fy_px=c.fy, cx_px=c.cx, cy_px=c.cy)
    return analyse(image.depth_m, sensor)


def models_of(panel: Panel) -> dict[str, ComponentModel]:
    """A model for each object of the panel file that range images are searched for, by the object's name."""
    tables = {one.name: one.relief.table() for one in panel.objects if one.relief is not None}
    models = models_from({"model": tables}, where=f"panel {panel.name}") if tables else ()
    return {model.name: model for model in models}


def find_by_surfaces(
    scene: RangeScene, image: Scan, panel: Panel, base_from_panel: UncertainPose, plate: Surface
) -> list[Sighting]:
    """Where the scan shows the panel's mushrooms and handwheels, each looked for near its place in the panel file.

    Args:
        plate: the plane that they stand on, in the scanner's frame.
        base_from_panel: where the panel is believed to be; it tells two of a kind apart.
    """
    reliefs = {one.name: one.relief for one in panel.objects if one.relief is not None}
    if not reliefs:
        return []
    models = models_of(panel)
    depth = np.asarray(image.depth_m, float)
    panel_from_scanner = base_from_panel.parent_from_child.inv() * image.base_from_scanner.parent_from_child
    points = panel_from_scanner.apply(scene.sensor.points(depth).reshape(-1, 3)).reshape(*depth.shape, 3)
    return [
        _sighting(panel.object(name), relief, models[name], scene, image, points, base_from_panel, plate)
        for name, relief in reliefs.items()
    ]


def _sighting(
    panel_object: PanelObject, relief: Relief, model: ComponentModel, scene: RangeScene, image: Scan, points: Array,
    base_from_panel: UncertainPose, plate: Surface,
) -> Sighting:  # fmt: skip
    """Of `points` (H, W, 3), in the panel's frame, only those about the object are looked at: that is what keeps it quick."""
    away = np.abs(points[..., :2] - panel_object.position_m).max(axis=-1)
    half = max(panel_object.half_footprint_m)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(point_covariance(base_from_panel, panel_object.point_m))[-1]))
    reach_m = NEAR_M + 3.0 * sigma_m
    if np.count_nonzero(away < half + 3.0 * sigma_m) < LEAST_PIXELS:
        return Sighting(panel_object=panel_object, why="not in the scanner's view")
    near = np.where(away < half + relief.height_m + reach_m, np.asarray(image.depth_m, float), np.nan)
    expected = base_from_panel.parent_from_child.apply([*panel_object.position_m, 0.0])
    found = []
    for match in match_models(scene, near, (model,), panel=plate):
        pose = compose(image.base_from_scanner, match.sensor_from_object)
        found.append((float(np.linalg.norm(pose.parent_from_child.translation - expected)), pose, match))
    if not found:
        return Sighting(panel_object=panel_object, why="no surfaces like its own near its place")
    off_m, pose, match = min(found, key=lambda f: f[0])
    if off_m > reach_m:
        return Sighting(
            panel_object=panel_object, why=f"the nearest like it stands {1e3 * off_m:.0f} mm from its place"
        )
    state = _state(relief, match, base_from_panel.parent_from_child.inv() * pose.parent_from_child)
    return Sighting(panel_object=panel_object, match=match, base_from_object=pose, off_m=off_m, state=state)


def _state(relief: Relief, match: Match, panel_from_object: RigidTransform) -> float | None:
    if relief.motion == "slide":
        return match.state
    x, y, _ = panel_from_object.rotation.apply([1.0, 0.0, 0.0])
    return float(-np.arctan2(y, x) % (2.0 * np.pi / relief.turns))


def mark_of(sighting: Sighting, image: Scan, base_from_panel: UncertainPose) -> Mark:
    """The object's outline at its height: where it was found, or else where it was looked for."""
    panel_object = sighting.panel_object
    found = sighting.base_from_object
    base_from_object = (
        found.parent_from_child
        if found is not None
        else base_from_panel.parent_from_child * RigidTransform.from_translation([*panel_object.position_m, 0.0])
    )
    turn = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS, endpoint=False)
    radius, relief = max(panel_object.half_footprint_m), panel_object.relief
    height_m = 0.0 if relief is None else relief.height_m
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(OUTLINE_POINTS, height_m)], axis=-1)
    x, y, z = (image.base_from_scanner.parent_from_child.inv() * base_from_object).apply(ring).T
    c, depth = image.capabilities, np.maximum(z, 1e-3)
    return Mark(
        outline_px=np.stack([c.fx * x / depth + c.cx, c.fy * y / depth + c.cy], axis=-1),
        text=panel_object.name if sighting.match is not None else f"{panel_object.name}: {sighting.why}",
        is_found=sighting.match is not None,
    )
