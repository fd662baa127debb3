"""Collision shapes: arm and tool as capsules, panel and surroundings as boxes.

A capsule is a segment with a radius. The distance from a point to a box is convex, so its minimum along a segment is
found by a golden-section search, and a check of the whole arm against the panel takes microseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from hal.geometry import product, transform_rpy
from hal.panel import Panel, PanelObject, Shown

Vector3 = tuple[float, float, float]


# A panel is set in a wall or cabinet of unknown size, so no path may lead round its edge: the hand could get caught.
WALL_BEYOND_M = 0.3
WALL_DEPTH_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Capsule:
    """A capsule fixed to the flange; both ends in flange axes, m."""

    name: str
    start_m: Vector3
    end_m: Vector3
    radius_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollisionBox:
    """A box: pose of its middle in the parent, and half its edges, m."""

    name: str
    parent_from_box: RigidTransform
    half_m: Vector3

    def moved(self, grand_from_parent: RigidTransform) -> CollisionBox:
        """Return the same box seen from the parent's parent."""
        return CollisionBox(
            name=self.name, parent_from_box=product(grand_from_parent, self.parent_from_box), half_m=self.half_m
        )


def panel_boxes(panel: Panel, shown: Mapping[str, Shown] | None = None) -> tuple[CollisionBox, ...]:
    """Return the plate and the objects of a panel as boxes in the panel frame; the plate includes the wall around it.

    Args:
        shown: present state of objects by name; a moving part whose place is not known gets the box of its whole way.
    """
    half_depth_m = max(panel.thickness_m, WALL_DEPTH_M) / 2
    plate = CollisionBox(
        name="plate",
        parent_from_box=transform_rpy((0.0, 0.0, -half_depth_m), (0.0, 0.0, 0.0)),
        half_m=(panel.width_m / 2 + WALL_BEYOND_M, panel.height_m / 2 + WALL_BEYOND_M, half_depth_m),
    )
    known = shown or {}
    return (plate, *(envelope(panel_object, known.get(panel_object.name)) for panel_object in panel.objects))


def envelope(panel_object: PanelObject, shown: Shown | None = None) -> CollisionBox:
    """Return a box in the panel frame that holds the object in any state, or a smaller one as it is `shown`."""
    room = panel_object.envelope(shown)
    foot = transform_rpy((*panel_object.position_m, 0.0), (0.0, 0.0, room.turn_rad))
    return CollisionBox(
        name=panel_object.name,
        parent_from_box=product(foot, transform_rpy((*room.middle_m, room.height_m / 2), (0.0, 0.0, 0.0))),
        half_m=(*room.half_m, room.height_m / 2),
    )


def floor_box(z_m: float) -> CollisionBox:
    """Return the floor as a box whose top lies at `z_m` of the base; the caller must exempt the arm's own foot."""
    return CollisionBox(
        name="floor",
        parent_from_box=transform_rpy((0.0, 0.0, z_m - 0.5), (0.0, 0.0, 0.0)),
        half_m=(3.0, 3.0, 0.5),
    )
