"""Pose of the panel from the looks of its objects: recognised without a pose, matched with the panel file, then measured.

Objects are recognised in a view that is rectified by the expected pose. The kinds and places of two of them propose
where the panel is; the proposal that explains most of the others is taken. The rims of the objects then give the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from hal.arrays import Array, Image
from hal.calibration import CameraIntrinsics
from hal.camera_model import check_size
from hal.errors import NotFound
from hal.geometry import UncertainPose, certain
from hal.panel import Panel
from perception.vision.finding.blind import Detection, candidate_places, chosen, lay_out
from perception.vision.finding.features import look_at
from perception.vision.image import as_gray
from perception.vision.knowledge import Knowledge
from perception.vision.lights.panel_finder import MODEL_SIGMA_PX, PanelPrior
from perception.vision.panel_ways.points import pose_from_points
from perception.vision.panel_ways.sighting import PanelSighting, PanelWay, check_fit, sighting
from perception.vision.projection import CameraProjection
from perception.vision.registration.rims import RimView, find_rims

MOST_SLACK_M = 0.10  # width around the plate that is searched too
LEAST_MATCHED, LEAST_SHARE = 5, 0.4  # objects, and share of the panel's objects, that must be recognised
LEAST_RIMS = 4
NEAR_M = 0.020  # of a recognised object from where the proposal has it
GROWTH, TURN_RAD = 0.2, 0.5  # largest difference of a proposal from the expected distance and roll
MATCHED_SIGMA_M = 0.005  # of a recognised object's middle
Pair = tuple[int, int]  # index of a detection, index of an object of the panel


def find_by_looks(
    image: NDArray[Any],
    panel: Panel,
    intrinsics: CameraIntrinsics,
    knowledge: Knowledge,
    *,
    prior: PanelPrior,
    lens_rms_px: float = MODEL_SIGMA_PX,
) -> PanelSighting:
    """Find the panel by its objects, near where the prior has it; neither its outline nor marks on it are needed.

    Raises:
        NotFound: too few objects are recognised or have a visible rim, or the prior does not allow the pose.
        Ambiguous: two poses fit equally well.
        WrongMark: the rims are not where the panel file has them.
        InvalidRequest: not an image, or of another size than the calibration.
    """
    gray = as_gray(image)
    check_size(gray, intrinsics)
    rough = _recognised(gray, panel, intrinsics, knowledge, prior)
    rims = _rims(gray, panel, intrinsics, rough)
    points_m, points_px = _places(rims)
    noise = np.array([rim.covariance_px for rim in rims]) + lens_rms_px**2 * np.eye(2)
    built = np.array([rim.built_covariance_px for rim in rims])
    found = pose_from_points(points_m, points_px, block_diag(*(noise + built)), intrinsics)
    check_fit(
        found, len(rims), f"the rims of {len(rims)} objects were seen, but not where the panel file has them",
        hint="measure position_m of the objects again, and check the lens calibration",
    )  # fmt: skip
    names = tuple(rim.name for rim in rims)
    return sighting(PanelWay.LOOKS, names, points_m, points_px, (noise, built), found, prior)


def _recognised(
    gray: Image, panel: Panel, intrinsics: CameraIntrinsics, knowledge: Knowledge, prior: PanelPrior
) -> UncertainPose:
    """Return a rough pose from the objects that are recognised in a view rectified by the expected pose."""
    slack_m = 2.0 * min(prior.position_tolerance_m, MOST_SLACK_M)
    area_m = (panel.width_m + slack_m, panel.height_m + slack_m)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=certain(prior.camera_from_panel))
    ground = lay_out(gray, view, area_m)
    places = candidate_places(ground)
    looks = chosen(ground, places, look_at(ground, places), knowledge, view, area_m) if len(places) else ()
    seen = [one for one in looks if one.reason is None]
    pairs = _matched(seen, panel)
    if len(pairs) < max(LEAST_MATCHED, LEAST_SHARE * len(panel.objects)):
        raise NotFound(
            f"only {len(pairs)} of the {len(panel.objects)} objects of panel {panel.name!r} were recognised by their looks",
            hint="show the whole panel, sharp and evenly lit; teach its objects (`panelwright learn`), or put tags on it",
        )
    points_m = np.array([panel.objects[k].point_m for _, k in pairs])
    points_px = np.array([seen[d].centre_px for d, _ in pairs])
    sigma_px = MATCHED_SIGMA_M * intrinsics.fx_px / max(float(prior.camera_from_panel.translation[2]), 0.05)
    return pose_from_points(points_m, points_px, sigma_px**2 * np.eye(2 * len(pairs)), intrinsics).poses[0]


def _matched(seen: Sequence[Detection], panel: Panel) -> list[Pair]:
    """Return the largest set of detections and objects of the same kinds that one shift, turn and scale explains."""
    kinds = np.array([one.kind for one in panel.objects])
    objects = np.array([complex(*one.position_m) for one in panel.objects])
    places = np.array([complex(*one.centre_m) for one in seen])
    same = [np.flatnonzero(kinds == one.kind) for one in seen]
    best: list[Pair] = []
    for a, b in combinations(range(len(seen)), 2):
        if abs(places[a] - places[b]) < 3 * NEAR_M:
            continue
        for i in same[a]:
            for j in same[b]:
                if i == j:
                    continue
                turn = (places[b] - places[a]) / (objects[j] - objects[i])
                if abs(abs(turn) - 1.0) > GROWTH or abs(np.angle(turn)) > TURN_RAD:
                    continue
                shift = places[a] - turn * objects[i]
                best = max(best, _explained(places, turn * objects + shift, same), key=len)
    return best


def _explained(places: Array, expected: Array, same: Sequence[NDArray[np.intp]]) -> list[Pair]:
    """Return the detections that are near an object of their kind, each object once."""
    pairs: dict[int, tuple[float, int]] = {}
    for d, candidates in enumerate(same):
        if not len(candidates):
            continue
        away = np.abs(expected[candidates] - places[d])
        k = int(candidates[int(away.argmin())])
        if away.min() < NEAR_M and (k not in pairs or away.min() < pairs[k][0]):
            pairs[k] = (float(away.min()), d)
    return [(d, k) for k, (_, d) in pairs.items()]


def _rims(gray: Image, panel: Panel, intrinsics: CameraIntrinsics, rough: UncertainPose) -> tuple[RimView, ...]:
    """Return the rims of the objects, searched twice, the second time from the pose that the first ones give."""
    pose = rough
    rims: tuple[RimView, ...] = ()
    for _ in range(2):
        rims = find_rims(gray, intrinsics, pose, panel)
        if len(rims) < LEAST_RIMS:
            raise NotFound(
                f"the rims of only {len(rims)} objects of panel {panel.name!r} are visible, and a pose needs {LEAST_RIMS}",
                hint="uncover the panel and light it evenly, or put tags on it",
            )
        covariance = block_diag(*(rim.covariance_px + rim.built_covariance_px for rim in rims))
        pose = pose_from_points(*_places(rims), covariance, intrinsics).poses[0]
    return rims


def _places(rims: Sequence[RimView]) -> tuple[Array, Array]:
    """Return the rims' points (N, 3) in the panel frame, and (N, 2) in the image."""
    return np.array([rim.point_m for rim in rims]), np.array([rim.pixel_px for rim in rims])
