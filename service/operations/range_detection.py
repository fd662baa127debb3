"""Objects of the panel file found by their surfaces in a range image: the emergency mushroom and the valve wheel."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.errors import Unsupported
from hal.geometry import UncertainPose
from hal.panel import Panel
from perception.range import (
    PanelView,
    PinholeSensor,
    RangeScene,
    Sighting,
    Surface,
    analyse,
    find_objects,
)
from service.operations.acquisition import Scan
from service.report.surfaces import Mark

OUTLINE_POINTS = 48


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


def find_by_surfaces(
    scene: RangeScene, image: Scan, panel: Panel, base_from_panel: UncertainPose, plate: Surface
) -> list[Sighting]:
    """Where the scan shows the panel's objects that have a relief; see `find_objects`."""
    depth_m = np.asarray(image.depth_m, float)
    view = PanelView(
        scene=scene,
        depth_m=depth_m,
        base_from_sensor=image.base_from_scanner,
        plate=plate,
        base_from_panel=base_from_panel,
    )
    return find_objects(panel, view)


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
