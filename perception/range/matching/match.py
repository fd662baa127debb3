"""Finding the components of a model library in an analysed scene.

Pieces of the scene suggest poses of models (`hypotheses`). Each pose is refined until it explains as much of the depth
image as possible (`search`, `verify`). Matches are then accepted best first, each taking the pixels that it explains,
and `placing` computes their covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array, Indices, Mask
from hal.geometry import UncertainPose
from perception.range.analysis import RangeScene
from perception.range.matching.hypotheses import candidate_of, pieces_of
from perception.range.matching.models import ComponentModel, MotionKind
from perception.range.matching.placing import placed_covariance
from perception.range.matching.search import Try, climb, refined, tries_of
from perception.range.matching.verify import BEHIND, COVERED, HITS, RING, View, explained
from perception.range.primitives import Plane, Surface

LEAST_SCORE = 45.0  # of a match; a pixel that agrees counts 3
LEAST_PIXELS = 20
LEAST_SEEN = 0.3  # least share of the pixels that the model covers that agree with it
LEAST_AGREEING = 0.78  # least share of agreement among the pixels that agree or contradict


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """A component found in a scene.

    Attributes:
        model: name of the model.
        sensor_from_object: pose and covariance; an angle named in `free` has the variance of a uniform full turn.
        labels: model surface name to surface label of the scene, for surfaces that the segmentation also found.
        state: position of the moving part along or about `motion_axis` (m or rad); None without one.
        state_sigma: its standard deviation.
        free: directions that the data do not fix, e.g. "turn about z".
        score: log-likelihood minus that of the bare panel; higher means more certain.
        seen: share of the pixels that the model covers where the image agrees with it.
    """

    model: str
    sensor_from_object: UncertainPose
    labels: dict[str, int]
    state: float | None
    state_sigma: float | None
    free: tuple[str, ...]
    score: float
    seen: float


def match_models(
    scene: RangeScene, depth_m: Array, models: Sequence[ComponentModel], *, panel: Surface | None = None
) -> tuple[Match, ...]:
    """Find the components that stand on a panel, best first; each pixel belongs to at most one of them.

    Args:
        scene: result of `analyse`.
        depth_m: (H, W) the image that was analysed.
        models: the kinds of components to look for.
        panel: the plane on which components stand; the scene's largest plane by default.

    Raises:
        NotFound: no panel is given and the scene shows no plane.
    """
    base = panel or scene.largest_plane()
    view = view_of(scene, depth_m, base)
    pieces = pieces_of(scene, view)
    tries = [t for model in models for t in tries_of(candidate_of(model), pieces, view)]
    tries = [refined(t, view) for t in tries]
    out: list[Match] = []
    while True:
        tries = [t for t in tries if t.score >= LEAST_SCORE]
        if not tries:
            return tuple(out)
        best = max(tries, key=lambda t: t.score)
        tries.remove(best)
        counts, rows, pixels = explained(best.candidate.solid, best.q, view)
        if not _holds(counts):
            continue
        seen = float(counts[HITS] / max(counts[COVERED], 1.0))
        out.append(_finished(best, base, view, seen, _labels(best.candidate.model, scene, rows, pixels)))
        view.depth_m[pixels] = np.nan
        tries = [climb(t.candidate, t.q, view) for t in tries]


def view_of(scene: RangeScene, depth_m: Array, base: Surface) -> View:
    """Prepare the image for comparison with hypotheses in the panel's frame.

    In that frame z is the outward normal, and x is the sensor's x axis projected into the panel.
    """
    plane = base.primitive
    if not isinstance(plane, Plane):
        raise TypeError(f"surface {base.label} is a {base.type}, not a plane")
    depth = np.where(np.isfinite(depth_m), depth_m, np.nan).astype(float)
    z = plane.normal
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    rays = scene.sensor.points(np.ones_like(depth))
    if scene.sensor.packed()[0] > 0:
        panel = float(z @ plane.point_m) / (rays @ z)
    else:
        panel = (float(z @ plane.point_m) - rays[..., :2] @ z[:2]) / z[2]
    return View(
        depth_m=depth,
        panel_m=panel,
        sigma_m=np.asarray(scene.noise.sigma_m(np.where(np.isfinite(depth), depth, 1.0))),
        packed=scene.sensor.packed(),
        R=np.stack([x, np.cross(z, x), z], axis=1),
        p=plane.point_m.copy(),
    )


def _holds(counts: Array) -> bool:
    """Return whether enough pixels agree with a hypothesis, in number and as a share, to accept it as a match."""
    against = counts[BEHIND] + counts[RING]
    return bool(
        counts[HITS] >= LEAST_PIXELS
        and counts[HITS] >= LEAST_SEEN * counts[COVERED]
        and counts[HITS] >= LEAST_AGREEING * (counts[HITS] + against)
    )


def _finished(t: Try, base: Surface, view: View, seen: float, labels: dict[str, int]) -> Match:
    """Build the match of an accepted hypothesis, with its covariance."""
    model = t.candidate.model
    x, y, yaw, state = t.q[:4]
    sensor_from_panel = RigidTransform.from_components(view.p, Rotation.from_matrix(view.R))
    panel_from_object = RigidTransform.from_components(np.array([x, y, 0.0]), Rotation.from_euler("z", yaw))
    covariance, state_sigma = placed_covariance(t, view, base)
    if model.motion == MotionKind.TURN:
        state = (yaw - model.low) % (model.high - model.low) + model.low
    return Match(
        model=model.name,
        sensor_from_object=UncertainPose(
            parent_from_child=sensor_from_panel * panel_from_object, covariance=covariance
        ),
        labels=labels,
        state=None if model.motion == MotionKind.NONE else float(state),
        state_sigma=None if model.motion == MotionKind.NONE else state_sigma,
        free=() if model.turns else ("turn about z",),
        score=t.score,
        seen=seen,
    )


def _labels(model: ComponentModel, scene: RangeScene, rows: Indices, pixels: Mask) -> dict[str, int]:
    """Return for each surface of the model the label that most of its explained pixels have in the scene."""
    out: dict[str, int] = {}
    for k, surface in enumerate(model.surfaces):
        votes = np.bincount(scene.labels[pixels & (rows == k)], minlength=1)
        votes[0] = 0
        if votes.max(initial=0) > 0:
            out[surface.name] = int(votes.argmax())
    return out
