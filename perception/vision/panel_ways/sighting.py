"""The panel as one way found it: pose with covariance, and the points of the panel that gave it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.special import chdtrc

from hal.arrays import Array
from hal.errors import PerceptionError
from hal.geometry import UncertainPose, difference
from perception.vision.lights.panel_finder import WRONG_FIT_P, PanelPrior, allowed_pose
from perception.vision.panel_ways.points import PointsPose

DISAGREE_P = 1e-4  # two ways whose poses differ by less probable errors than this contradict each other


class PanelWay(StrEnum):
    """What the panel is found by."""

    LIGHTS = "lights"
    TAGS = "tags"
    OUTLINE = "outline"
    LOOKS = "looks"


class WrongMark(PerceptionError):
    """Points of the panel were seen, but not where the panel file has them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelSighting:
    """The panel found in one way.

    Attributes:
        way: what it was found by.
        camera_from_panel: its pose; the covariance has image noise, lens, and tolerances of the built panel.
        names: of the N points of the panel that were seen.
        points_m, points_px: (N, 3) in the panel frame, and (N, 2) in the image, not undistorted.
        covariance_px: (N, 2, 2) of each point's pixel by image noise and lens.
        built_covariance_px: (N, 2, 2) that the tolerances of the built panel add, common to all views.
        chi_square, degrees_of_freedom: of the fit.
        ambiguous: another pose, such as the mirrored one, fits nearly as well.
        alternatives: number of other poses.
    """

    way: PanelWay
    camera_from_panel: UncertainPose
    names: tuple[str, ...]
    points_m: Array
    points_px: Array
    covariance_px: Array
    built_covariance_px: Array
    chi_square: float
    degrees_of_freedom: int
    ambiguous: bool
    alternatives: int


def fits(found: PointsPose, points: int) -> bool:
    """Return whether a worse fit of so many points is not too improbable."""
    return bool(chdtrc(2 * points - 6, found.chi_square) >= WRONG_FIT_P)


def check_fit(found: PointsPose, points: int, what: str, *, hint: str) -> None:
    """Raise `WrongMark`, which says `what` does not fit and what helps, if the pose of so many points fits too badly."""
    if not fits(found, points):
        raise WrongMark(
            f"{what} (chi-square {found.chi_square:.0f} on {2 * points - 6} degrees of freedom)",
            hint=hint, chi_square=round(found.chi_square, 1),
        )  # fmt: skip


def sighting(
    way: PanelWay, names: tuple[str, ...], points_m: Array, points_px: Array, covariances_px: tuple[Array, Array],
    found: PointsPose, prior: PanelPrior,
) -> PanelSighting:  # fmt: skip
    """Return the panel as found by points; `covariances_px` are `covariance_px` and `built_covariance_px`.

    Raises:
        NotFound, Ambiguous: see `allowed_pose`.
    """
    by = "objects" if way is PanelWay.LOOKS else way.value
    return PanelSighting(
        way=way, camera_from_panel=allowed_pose(found.poses, prior, ambiguous=found.ambiguous, by=by), names=names,
        points_m=points_m, points_px=points_px, covariance_px=covariances_px[0], built_covariance_px=covariances_px[1],
        chi_square=found.chi_square, degrees_of_freedom=2 * len(points_m) - 6, ambiguous=found.ambiguous,
        alternatives=len(found.poses) - 1,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """The difference between the poses of two ways, and whether it contradicts their covariances.

    `chi_square` has 6 degrees of freedom.
    """

    position_m: float
    angle_rad: float
    chi_square: float
    contradicts: bool


def compare(one: PanelSighting, other: PanelSighting) -> Comparison:
    """Compare two sightings in one image; errors that both share, such as the lens, make the comparison milder."""
    a, b = one.camera_from_panel, other.camera_from_panel
    off = difference(a.parent_from_child, b.parent_from_child)
    chi_square = float(off @ np.linalg.solve(a.covariance + b.covariance, off))
    return Comparison(
        position_m=float(np.linalg.norm(off[:3])),
        angle_rad=float(np.linalg.norm(off[3:])),
        chi_square=chi_square,
        contradicts=bool(chdtrc(6, chi_square) < DISAGREE_P),
    )
