"""Compares rendered models with a search along each ray, and tests hypotheses by comparison with such renderings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.range import PinholeSensor
from perception.range.matching.hypotheses import candidate_of
from perception.range.matching.models import ComponentModel, load_models, models_from
from perception.range.matching.search import Try, climb, growths_of, refined, ways_of
from perception.range.matching.solids import boxes_of, hit, render, solid_of
from perception.range.matching.verify import BEHIND, COVERED, FRONT, HITS, RING, View, explained

SENSOR = PinholeSensor(width_px=120, height_px=100, fx_px=260.0, fy_px=260.0, cx_px=59.5, cy_px=49.5)
SIGMA_M = 0.0004

FORMS = {
    "disc": {"type": "plane", "direction": [0.2, 0.1, 1.0], "point_m": [0, 0, 0.01], "size_m": 0.02},
    "rectangle": {"type": "plane", "direction": [0, 0.3, 1.0], "sides_m": [0.05, 0.02], "along": [1, 0.5, 0]},
    "cylinder": {"type": "cylinder", "direction": [1, 0.2, 0.4], "size_m": 0.012, "length_m": 0.05},
    "cone": {
        "type": "cone",
        "direction": [0, 0, -1],
        "point_m": [0, 0, 0.05],
        "half_angle_rad": 0.5,
        "between_m": [0.0, 0.03],
    },
    "sphere": {"type": "sphere", "size_m": 0.02, "between_m": [0.005, 0.03]},
    "ellipsoid": {"type": "ellipsoid", "radii_m": [0.03, 0.02, 0.01]},
    "torus": {"type": "torus", "direction": [0.1, 0, 1], "size_m": 0.025, "tube_m": 0.006},
}


def model_of(*surfaces: dict[str, object], **more: object) -> ComponentModel:
    """Return a model of the given rows."""
    named = [{"name": f"s{k}", **s} for k, s in enumerate(surfaces)]
    return models_from({"model": {"thing": {"surfaces": named, **more}}})[0]


def inside(form: str, X: np.ndarray) -> np.ndarray:
    """Return the sign of the surface's equation at points X (N, 3), NaN outside its bounds; an independent version."""
    s = model_of(FORMS[form]).surfaces[0]
    W, d = X - s.point_m, s.direction
    h = W @ d
    across = np.linalg.norm(W - h[:, None] * d, axis=1)
    match form:
        case "disc":
            return np.where(across <= s.size_m, h, np.nan)
        case "rectangle":
            a, b = W @ s.along, W @ np.cross(d, s.along)
            return np.where((abs(a) <= s.sides_m[0] / 2) & (abs(b) <= s.sides_m[1] / 2), h, np.nan)
        case "cylinder":
            return np.where(abs(h) <= s.length_m / 2, across - s.size_m, np.nan)
        case "cone":
            keep = (X[:, 2] >= s.between_m[0]) & (X[:, 2] <= s.between_m[1])
            return np.where(keep, across - h * np.tan(s.half_angle_rad), np.nan)
        case "sphere":
            return np.where(X[:, 2] >= s.between_m[0], np.linalg.norm(W, axis=1) - s.size_m, np.nan)
        case "ellipsoid":
            return np.linalg.norm(W / s.radii_m, axis=1) - 1.0
    return np.hypot(across - s.size_m, h) - s.tube_m


@pytest.mark.parametrize("form", FORMS)
@given(
    x=st.floats(-0.03, 0.03),
    y=st.floats(-0.03, 0.03),
    slant=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_a_ray_meets_each_form_where_a_search_along_it_does(form, x, y, slant):
    direction = np.array([*slant, -1.0])
    origin = np.array([x, y, 0.0]) - 0.2 * direction
    found = hit(solid_of(model_of(FORMS[form]))[0], 0.0, *origin, *direction)
    t = np.linspace(0.1, 0.3, 8001)
    values = inside(form, origin + t[:, None] * direction)
    crossing = np.flatnonzero(values[:-1] * values[1:] <= 0.0)
    if crossing.size == 0:
        # The search may miss grazing hits and rims, but the point found by the ray must be on a surface.
        near = values[np.argmin(abs(t - found))] if np.isfinite(found) else 0.0
        assert not np.isfinite(found) or np.isnan(near) or abs(near) < 2e-4 * (50.0 if form == "ellipsoid" else 1.0)
        return
    assert found == pytest.approx(t[crossing[0]], abs=2e-4) or np.isnan(values[crossing[0] - 1 : crossing[0] + 3]).any()


@pytest.mark.parametrize("form", [f for f in FORMS if f != "ellipsoid"])
def test_a_grown_surface_covers_more(form):
    row = solid_of(model_of(FORMS[form]))[0]
    rng = np.random.default_rng(1)
    count = [0, 0]
    for x, y in rng.uniform(-0.05, 0.05, (800, 2)):
        for k, grow in enumerate((0.0, 0.004)):
            count[k] += np.isfinite(hit(row, grow, x, y, 0.2, 0.0, 0.0, -1.0))
    assert 0 < count[0] < count[1]


def test_boxes_hold_what_is_drawn():
    for model in load_models():
        rows, boxes = solid_of(model), boxes_of(model)
        rng = np.random.default_rng(2)
        for x, y in rng.uniform(-0.12, 0.12, (300, 2)):
            d = np.array([*rng.uniform(-0.4, 0.4, 2), -1.0])
            o = np.array([x, y, 0.0]) - 0.3 * d
            for row, box in zip(rows, boxes, strict=True):
                t = hit(row, 0.0, *o, *d)
                if np.isfinite(t):
                    assert (o + t * d >= box[0] - 1e-9).all() and (o + t * d <= box[1] + 1e-9).all()


def panel_view(depth: np.ndarray | None = None) -> View:
    """Return the panel's pose, 0.5 m away, facing the sensor with a tilt."""
    tilt = 0.2
    z = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    x = np.array([1.0, 0.0, 0.0])
    p = np.array([0.0, 0.0, 0.5])
    rays = SENSOR.points(np.ones((SENSOR.height_px, SENSOR.width_px)))
    panel = (z @ p) / (rays @ z)
    return View(
        depth_m=panel.copy() if depth is None else depth,
        panel_m=panel,
        sigma_m=np.full(panel.shape, SIGMA_M),
        packed=SENSOR.packed(),
        R=np.stack([x, np.cross(z, x), z], axis=1),
        p=p,
    )


def drawn(model: ComponentModel, q: np.ndarray, seed: int = 0) -> View:
    """Return a noisy view of the model with pose q in front of the panel."""
    view = panel_view()
    c, s = np.cos(q[2]), np.sin(q[2])
    R = view.R @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    p = view.p + view.R @ [q[0], q[1], 0.0]
    m, k = np.empty(view.depth_m.shape), np.empty(view.depth_m.shape, np.int64)
    window = np.array([0, 0, SENSOR.width_px, SENSOR.height_px])
    shift = np.asarray(model.motion_axis) * q[3]
    render(
        solid_of(model), boxes_of(model), np.zeros(len(model.surfaces)), shift, R, p, SENSOR.packed(), window, 1, m, k
    )
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, m.shape)
    return panel_view(np.minimum(m, view.panel_m) + noise)


def named(name: str) -> ComponentModel:
    """Return a model of the shipped library."""
    return next(m for m in load_models() if m.name == name)


def start(model: ComponentModel, *q: float) -> np.ndarray:
    """Return a hypothesis without growth."""
    return np.array([*q, *np.zeros(len(model.surfaces))])


@pytest.mark.parametrize(
    ("name", "pose"),
    [("push_button", (0.01, 0.02, 0, 0)), ("toggle_lever", (0.0, 0.01, 0.7, 0)), ("meter", (0.01, 0, 0.3, 0))],
)
def test_a_climb_finds_the_pose_that_was_drawn(name, pose):
    model = named(name)
    candidate, view = candidate_of(model), drawn(model, np.array(pose))
    q = start(model, pose[0] + 0.004, pose[1] - 0.003, pose[2] + (0.08 if model.turns else 0.0), 0.0)
    coarse = climb(candidate, q, view, ways=ways_of(model, q, 0.004, 0.1), levels=4, stride=1)
    fine = refined(coarse, view)
    assert np.linalg.norm(fine.q[:2] - pose[:2]) < 0.0007
    assert abs(fine.q[2] - pose[2]) < 0.02
    counts, _, _ = explained(candidate.solid, fine.q, view)
    assert counts[HITS] > 0.93 * counts[COVERED] and counts[RING] < 0.1 * counts[COVERED]


def test_hidden_pixels_cost_little_and_seen_through_ones_much():
    model = named("meter")
    candidate, pose = candidate_of(model), np.array([0.0, 0.0, 0.0, 0.0])
    q, view = start(model, *pose), drawn(model, pose)
    whole = climb(candidate, q, view).score
    half = view.depth_m.copy()
    half[:, :60] = 0.3  # a board in front
    behind = panel_view(half)
    hidden = climb(candidate, q, behind)
    assert 0.3 * whole < hidden.score < 0.6 * whole
    counts, _, _ = explained(candidate.solid, q, behind)
    assert counts[FRONT] > 0.4 * counts[COVERED] and counts[BEHIND] < 0.02 * counts[COVERED]
    half[:, :60] = 0.8  # the sensor sees beyond the model
    assert climb(candidate, q, panel_view(half)).score < 0.1 * whole
    assert climb(candidate, q, panel_view()).score < 0.0


def test_what_goes_on_beyond_the_outline_contradicts():
    small, large = (
        named("push_button"),
        model_of({"type": "plane", "direction": [0, 0, 1], "point_m": [0, 0, 0.01], "size_m": 0.03}),
    )
    q = start(small, 0.0, 0.0, 0.0, 0.0)
    pose = np.zeros(4)
    right, wrong = drawn(small, pose), drawn(large, pose)
    candidate = candidate_of(small)
    assert explained(candidate.solid, q, right)[0][RING] < 5
    assert explained(candidate.solid, q, wrong)[0][RING] > 30
    assert climb(candidate, q, wrong).score < climb(candidate, q, right).score - 60.0


def test_only_sizes_that_may_differ_grow():
    candidate = candidate_of(named("valve_wheel"))
    growths = growths_of(candidate, 4 + len(candidate.solid.rows))
    assert growths.shape[0] == 1 and growths[0, 4 + 1] > 0  # the growth of its rim


def test_refining_never_loses():
    model = named("push_button")
    view = drawn(model, np.zeros(4), seed=3)
    t = Try(candidate=candidate_of(model), q=start(model, 0.002, 0, 0, 0), score=0.0)
    assert refined(t, view).score >= climb(t.candidate, t.q, view).score
