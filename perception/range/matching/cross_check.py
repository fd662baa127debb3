"""Comparison of objects found by their surfaces with the panel file and with another reading of their state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from hal.arrays import Array
from hal.geometry import UncertainPose, compose
from perception.range.matching.panel_objects import Sighting
from perception.range.sensor import PinholeSensor

OUTLINE_POINTS = 48  # points of the circle around an object
ELSEWHERE_P = 1e-3  # probability that an object in its right place is taken for displaced
TURN_SLACK_RAD = 0.1  # allowed between two readings of a wheel's angle, in addition to three sigmas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaceCheck:
    """Where an object stands on the plate, in comparison with the panel file.

    Attributes:
        at_m: (2,) panel frame.
        off_m: distance from its place in the panel file.
        sigma_m: standard deviation of that distance along one axis.
        chi_square: of the distance, with two degrees of freedom.
    """

    at_m: Array
    off_m: float
    sigma_m: float
    chi_square: float

    @property
    def is_elsewhere(self) -> bool:
        """Whether it stands further from its place than chance explains."""
        return bool(self.chi_square > chdtri(2, ELSEWHERE_P))


def check_place(sighting: Sighting, base_from_panel: UncertainPose, position_m: float) -> PlaceCheck | None:
    """Compare the place of an object with the panel file; None if it was not found.

    Args:
        position_m: one sigma of the distance between an object of a built panel and its place in the file.
    """
    if sighting.base_from_object is None:
        return None
    panel_from_object = compose(base_from_panel.inverse(), sighting.base_from_object)
    at = panel_from_object.parent_from_child.translation[:2]
    off = at - sighting.panel_object.position_m
    C = panel_from_object.covariance[:2, :2] + position_m**2 * np.eye(2)
    return PlaceCheck(
        at_m=at,
        off_m=float(np.linalg.norm(off)),
        sigma_m=float(np.sqrt(0.5 * np.trace(C))),
        chi_square=float(off @ np.linalg.solve(C, off)),
    )


def states_agree(
    sighting: Sighting, *, state: str | None = None, value: float | None = None, sigma: float | None = None
) -> bool:
    """Return whether surfaces and another reading give the same state, or at least one of them gives none.

    Args:
        state: the other reading of what slides: `pressed` or `released`.
        value, sigma: the other reading of what turns, clockwise, and its standard deviation, rad.
    """
    relief, match, found = sighting.panel_object.relief, sighting.match, sighting.state
    if relief is None or match is None or found is None:
        return True
    if relief.motion == "slide":
        return state is None or relief.state_name(found) == state
    if value is None:
        return True
    spoke = 2.0 * np.pi / relief.turns
    apart = abs((found - value + 0.5 * spoke) % spoke - 0.5 * spoke)
    return bool(apart <= TURN_SLACK_RAD + 3.0 * np.hypot(match.state_sigma or 0.0, sigma or 0.0))


def outline_px(
    sighting: Sighting, sensor: PinholeSensor, base_from_sensor: RigidTransform, base_from_panel: RigidTransform
) -> Array:
    """Return a circle (N, 2) around an object at its height, px; if it was not found, at its expected place."""
    panel_object, found = sighting.panel_object, sighting.base_from_object
    base_from_object = (
        found.parent_from_child
        if found is not None
        else base_from_panel * RigidTransform.from_translation([*panel_object.position_m, 0.0])
    )
    turn = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS, endpoint=False)
    radius, relief = max(panel_object.half_footprint_m), panel_object.relief
    height_m = 0.0 if relief is None else relief.height_m
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(OUTLINE_POINTS, height_m)], axis=-1)
    x, y, z = (base_from_sensor.inv() * base_from_object).apply(ring).T
    depth = np.maximum(z, 1e-3)
    return np.stack([sensor.fx_px * x / depth + sensor.cx_px, sensor.fy_px * y / depth + sensor.cy_px], axis=-1)
