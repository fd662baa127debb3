"""Tests of the model file, and of components found by their surfaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import perception.range.matching
from hal.errors import ConfigError
from perception.range import PinholeSensor, analyse
from perception.range.matching.match import match_models
from perception.range.matching.models import MotionKind, load_models, models_from
from tests.perception.range.scenes import plane_depth, rays, sphere_depth

LIBRARY = Path(perception.range.matching.__file__).parent / "components.toml"
SENSOR = PinholeSensor(width_px=240, height_px=200, fx_px=500.0, fy_px=500.0, cx_px=119.5, cy_px=99.5)
NORMAL = np.array([0.15, 0.2, -1.0]) / np.linalg.norm([0.15, 0.2, -1.0])
MIDDLE = np.array([0.0, 0.0, 0.6])


def place(x_m: float, y_m: float, height_m: float) -> np.ndarray:
    """Return a point of the panel frame: x is the sensor's x projected into the plane, z points outward."""
    x = np.array([1.0, 0, 0]) - NORMAL[0] * NORMAL
    x /= np.linalg.norm(x)
    return MIDDLE + x * x_m + np.cross(NORMAL, x) * y_m + NORMAL * height_m


def disc_depth(centre: np.ndarray, radius: float) -> np.ndarray:
    origin, direction = rays(SENSOR)
    depth = plane_depth(SENSOR, NORMAL, centre)
    away = origin + depth[..., None] * direction - centre
    return np.where(np.linalg.norm(away, axis=-1) <= radius, depth, np.inf)


def panel_image(seed: int, pressed_m: float = 0.0, hidden: bool = False) -> np.ndarray:
    """Return a depth image of an emergency knob, a push button and a lamp on a panel."""
    parts = [
        plane_depth(SENSOR, NORMAL, MIDDLE),
        sphere_depth(SENSOR, place(-0.06, 0.0, 0.010 - pressed_m), 0.030),
        disc_depth(place(0.05, 0.04, 0.010), 0.013),
        sphere_depth(SENSOR, place(0.05, -0.04, 0.0), 0.013),
    ]
    depth = np.min(parts, axis=0)
    if hidden:
        depth[:, 60:82] = 0.4  # a bar hides more than a third of the knob
    return depth + np.random.default_rng(seed).normal(0, 0.0004, depth.shape)


def found(depth: np.ndarray):
    scene = analyse(depth, SENSOR)
    return {m.model: m for m in match_models(scene, depth, load_models(LIBRARY))}


def test_the_shipped_library_holds_ten_models():
    models = load_models(LIBRARY)
    assert len(models) >= 10
    assert {m.name for m in models} >= {"emergency_knob", "valve_wheel", "slider"}


@pytest.mark.parametrize("hidden", [False, True], ids=["clear", "partly hidden"])
def test_knob_button_and_lamp_are_found_where_they_are(hidden):
    matches = found(panel_image(0, hidden=hidden))
    assert set(matches) == {"emergency_knob", "push_button", "indicator_lamp"}
    places = {"emergency_knob": (-0.06, 0), "push_button": (0.05, 0.04), "indicator_lamp": (0.05, -0.04)}
    for name, (x, y) in places.items():
        pose = matches[name].sensor_from_object.parent_from_child
        assert np.linalg.norm(pose.translation - place(x, y, 0.0)) < 0.001
        assert np.degrees(np.arccos(pose.rotation.as_matrix()[:, 2] @ NORMAL)) < 0.5


def test_a_pressed_knob_says_so():
    match = found(panel_image(1, pressed_m=0.004))["emergency_knob"]
    assert match.state == pytest.approx(-0.004, abs=0.0005)
    assert match.state_sigma is not None and match.state_sigma < 0.001


def test_symmetry_is_stated_and_its_turn_is_free():
    match = found(panel_image(2))["emergency_knob"]
    assert match.free == ("turn about z",)
    turn_variance = NORMAL @ match.sensor_from_object.covariance[3:, 3:] @ NORMAL
    assert turn_variance > 1.0
    assert np.linalg.eigvalsh(match.sensor_from_object.covariance).min() > -1e-12


def test_what_is_hidden_widens_the_covariance():
    clear, hidden = (found(panel_image(4, hidden=h))["emergency_knob"] for h in (False, True))
    sigmas = [np.sqrt(np.trace(m.sensor_from_object.covariance[:3, :3])) for m in (clear, hidden)]
    assert 1e-5 < sigmas[0] < 0.001 and sigmas[0] <= sigmas[1] < 0.002
    assert hidden.seen < 0.8 < clear.seen
    assert hidden.score < clear.score


def test_two_of_a_kind_share_the_pixels():
    parts = [
        plane_depth(SENSOR, NORMAL, MIDDLE),
        sphere_depth(SENSOR, place(0.0, -0.03, 0.0), 0.013),
        sphere_depth(SENSOR, place(0.0, 0.01, 0.0), 0.013),
    ]
    depth = np.min(parts, axis=0) + np.random.default_rng(5).normal(0, 0.0004, parts[0].shape)
    scene = analyse(depth, SENSOR)
    matches = match_models(scene, depth, load_models(LIBRARY))
    assert [m.model for m in matches] == ["indicator_lamp"] * 2
    ys = sorted(
        float(m.sensor_from_object.parent_from_child.translation @ np.cross(NORMAL, [1, 0, 0])) for m in matches
    )
    assert ys[1] - ys[0] == pytest.approx(0.04, abs=0.002)
    assert matches[0].labels["dome"] != matches[1].labels["dome"]


def test_caps_of_two_buttons_at_one_height_are_one_surface_and_two_buttons():
    plate = plane_depth(SENSOR, NORMAL, MIDDLE)
    caps = [disc_depth(place(x, 0.01, 0.010), 0.013) for x in (-0.03, 0.03)]
    depth = np.min([plate, *caps], axis=0) + np.random.default_rng(7).normal(0, 0.0004, plate.shape)
    depth[:, 102:138] = 0.4  # a bar from one to the other
    scene = analyse(depth, SENSOR)
    assert len(scene.surfaces) == 3
    buttons = [m for m in load_models(LIBRARY) if m.name == "push_button"]
    matches = match_models(scene, depth, buttons)
    assert [m.model for m in matches] == ["push_button"] * 2


def test_a_plane_is_needed_to_stand_on():
    scene = analyse(panel_image(6), SENSOR)
    ball = next(s for s in scene.surfaces if s.type == "sphere")
    with pytest.raises(TypeError):
        match_models(scene, panel_image(6), load_models(LIBRARY), panel=ball)


def test_clutter_alone_matches_nothing():
    parts = [plane_depth(SENSOR, NORMAL, MIDDLE), sphere_depth(SENSOR, place(0.0, 0.0, 0.03), 0.05)]
    depth = np.min(parts, axis=0) + np.random.default_rng(3).normal(0, 0.0004, parts[0].shape)
    assert found(depth) == {}


GOOD = {"surfaces": [{"name": "cap", "type": "sphere", "size_m": 0.02}]}
FACE = {"type": "plane", "direction": [0, 0, 2.0], "sides_m": [0.04, 0.02]}


def test_a_small_model_reads():
    (model,) = models_from({"model": {"ball": GOOD}})
    assert model.surfaces[0].name == "cap" and model.motion == MotionKind.NONE
    assert model.turns == 1 and model.period_rad == pytest.approx(2 * np.pi)


def test_a_rectangle_gets_a_first_side_in_its_face():
    (model,) = models_from({"model": {"box": {"surfaces": [{**FACE, "along": [1.0, 0, 1.0]}], "turns": 2}}})
    face = model.surfaces[0]
    assert face.direction.tolist() == [0, 0, 1] and face.along.tolist() == [1, 0, 0]
    assert model.period_rad == pytest.approx(np.pi)


@pytest.mark.parametrize(
    "broken",
    [
        {},
        {"model": {}},
        {"model": {"ball": {**GOOD, "colour": 1}}},
        {"model": {"ball": {"surfaces": []}}},
        {"model": {"ball": {"surfaces": [{"type": "blob"}]}}},
        {"model": {"ball": {"surfaces": [{"type": "sphere"}]}}},
        {"model": {"ball": {"surfaces": [{"type": "plane", "size_m": 0.02}]}}},
        {"model": {"ball": {"surfaces": [{"type": "plane", "direction": [0, 0, 1]}]}}},
        {"model": {"ball": {"surfaces": [{**FACE, "direction": [0, 0, 0]}]}}},
        {"model": {"ball": {"surfaces": [{**FACE, "along": [0, 0, 1]}]}}},
        {"model": {"ball": {"surfaces": [{**FACE, "sides_m": [0.04]}]}}},
        {"model": {"ball": {**GOOD, "turns": -1}}},
        {"model": {"ball": {**GOOD, "turns": True}}},
        {"model": {"ball": {"surfaces": [*GOOD["surfaces"], *GOOD["surfaces"]]}}},
        {"model": {"ball": {**GOOD, "motion": "hop"}}},
        {"model": {"ball": {**GOOD, "motion": "slide"}}},
        {"model": {"ball": {"surfaces": [{**GOOD["surfaces"][0], "size_m": "big"}]}}},
        {"model": {"ball": {"surfaces": [{**GOOD["surfaces"][0], "point_m": [0, 1]}]}}},
    ],
)
def test_a_broken_model_is_refused_by_name(broken):
    with pytest.raises(ConfigError) as caught:
        models_from(broken)
    assert caught.value.hint


def test_a_missing_or_broken_file_is_refused(tmp_path):
    with pytest.raises(ConfigError):
        load_models(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[model", encoding="utf-8")
    with pytest.raises(ConfigError):
        load_models(tmp_path / "bad.toml")
