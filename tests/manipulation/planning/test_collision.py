from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hal.errors import Unreachable
from hal.geometry import identity, transform_rpy
from hal.panel import Lever, Panel, Shown, Slider, Toggle
from hal.strict import validate
from manipulation.arm.kinematics import Kinematics
from manipulation.planning import clearance
from manipulation.planning.collision import RECHECK_RAD, CollisionModel, placed
from manipulation.planning.shapes import Capsule, CollisionBox, envelope, floor_box, panel_boxes
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.planning.transfer import TransferPlanner
from tests.manipulation.arms import T3

points = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)
TOOL = (Capsule(name="hand", start_m=(0.0, 0.0, 0.03), end_m=(0.0, 0.0, 0.12), radius_m=0.04),)
KINEMATICS = Kinematics.of(T3)


@given(a=points, b=points, turn=points, middle=points)
@settings(max_examples=60, deadline=None)
def test_segment_to_box_is_the_least_over_many_points(
    a: np.ndarray, b: np.ndarray, turn: np.ndarray, middle: np.ndarray
) -> None:
    rotation, half = Rotation.from_rotvec(turn).as_matrix(), np.array([0.1, 0.3, 0.2])
    found = clearance.segment_box(a, b, rotation, middle, half)
    along = np.linspace(0, 1, 4001)[:, None]
    local = (a + along * (b - a) - middle) @ rotation
    outside = np.abs(local) - half
    gaps = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)
    assert found == pytest.approx(gaps.min(), abs=1.5e-3)


@given(a=points, b=points, c=points, d=points)
@settings(max_examples=60, deadline=None)
def test_segment_to_segment_is_the_least_over_a_grid(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray
) -> None:
    u = np.linspace(0, 1, 301)
    first, second = a + u[:, None] * (b - a), c + u[:, None] * (d - c)
    least = np.linalg.norm(first[:, None] - second[None], axis=-1).min()
    found = clearance.segment_segment(a, b, c, d)
    assert found <= least + 1e-7
    assert found == pytest.approx(least, abs=1.2e-2)


def test_a_box_in_the_forearm_is_found_and_named() -> None:
    q = np.array([0.0, 0.3, 0.3, 0.0, 0.5, 0.0])
    tip = KINEMATICS.flange(q).translation
    box = CollisionBox(name="post", parent_from_box=transform_rpy(tip, (0, 0, 0)), half_m=(0.02, 0.02, 0.02))
    model = CollisionModel.build(KINEMATICS, TOOL, [box])
    assert not model.is_clear(q, margin_m=0.0)
    assert "post" in model.nearest(q)
    assert model.with_boxes([box], ignored=[("", "post")]).is_clear(q, margin_m=0.0)


def test_of_several_boxes_with_one_name_the_nearest_is_named() -> None:
    q = np.array([0.0, 0.3, 0.3, 0.0, 0.5, 0.0])
    near = CollisionBox(
        name="cable", parent_from_box=transform_rpy(KINEMATICS.flange(q).translation, (0, 0, 0)), half_m=(0.02,) * 3
    )
    far = CollisionBox(name="cable", parent_from_box=transform_rpy((5.0, 0.0, 0.0), (0, 0, 0)), half_m=(0.02,) * 3)
    assert "cable" in CollisionModel.build(KINEMATICS, TOOL, [near, far]).nearest(q)


def test_the_distance_of_points_from_the_arm_is_that_of_a_small_box_there() -> None:
    q, rng = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7]), np.random.default_rng(5)
    places = KINEMATICS.flange(q).translation + rng.uniform(-0.5, 0.5, (20, 3))
    model = CollisionModel.build(KINEMATICS, TOOL)
    boxes = [
        CollisionBox(name="dot", parent_from_box=transform_rpy(place, (0, 0, 0)), half_m=(1e-6,) * 3)
        for place in places
    ]
    apart = [min(model.with_boxes([box]).clearance_m(q), np.inf) for box in boxes]
    ours = model.clearance_m(q)  # of the arm from itself
    for distance, least in zip(model.distances_m(q, places), apart, strict=True):
        assert min(float(distance), ours) == pytest.approx(least, abs=1e-5)


def test_an_ordinary_pose_does_not_touch_itself_and_a_folded_one_does() -> None:
    model = CollisionModel.build(KINEMATICS, TOOL)
    assert model.is_clear(np.array([0.0, 0.2, 0.5, 0.0, 0.9, 0.0]), margin_m=0.01)
    # The forearm is folded back along the upper arm, and the wrist is bent towards it.
    folded = [np.array([0.0, 0.0, 1.6, 0.0, wrist, 0.0]) for wrist in np.linspace(-2.8, 2.8, 15)]
    assert min(model.clearance_m(q) for q in folded) < 0.0


def _obstacle() -> tuple[np.ndarray, np.ndarray, CollisionBox]:
    start = np.array([-0.7, 0.6, 0.2, 0.0, 0.6, 0.0])
    goal = np.array([0.7, 0.6, 0.2, 0.0, 0.6, 0.0])
    middle = KINEMATICS.flange(0.5 * (start + goal)).translation
    wall = CollisionBox(name="divider", parent_from_box=transform_rpy(middle, (0, 0, 0)), half_m=(0.15, 0.02, 0.15))
    return start, goal, wall


def _planner(*boxes: CollisionBox, seed: int = 1) -> TransferPlanner:
    return TransferPlanner(
        model=CollisionModel.build(KINEMATICS, TOOL, boxes),
        flange_from_tool=transform_rpy((0, 0, 0.15), (0, 0, 0)),
        limits=SpeedLimits(tip_m_per_s=0.25),
        seed=seed,
    )


def test_a_transfer_goes_round_a_divider_and_every_five_milliradians_are_free() -> None:
    start, goal, wall = _obstacle()
    planner = _planner(wall)
    assert planner.model.free_fraction(start, goal, margin_m=0.0) < 1.0
    motion = planner.plan(start, goal)
    q = motion.positions_rad
    assert np.allclose(q[0], start) and np.allclose(q[-1], goal)
    for a, b in itertools.pairwise(q):
        assert planner.model.free_fraction(a, b, margin_m=0.0, step_rad=RECHECK_RAD) == 1.0


def test_a_post_between_the_steps_of_a_search_is_found_before_the_arm_moves() -> None:
    """A search looks every 20 mrad, in which a finger may pass a cable."""
    finger = Capsule(name="finger", start_m=(0.0, 0.0, 0.10), end_m=(0.0, 0.0, 0.25), radius_m=0.002)
    start, goal = (np.array([side, 0.6, 0.2, 0.0, 0.6, 0.0]) for side in (-0.3, 0.3))
    between = KINEMATICS.flange(start + 10.5 / 30 * (goal - start)) * transform_rpy((0.0, 0.0, 0.2), (0, 0, 0))
    post = CollisionBox(name="post", parent_from_box=between, half_m=(0.0005, 0.0005, 0.0005))
    planner = replace(_planner(), model=CollisionModel.build(KINEMATICS, [finger], [post]))
    path, margin = np.array([start, 0.5 * (start + goal), goal]), 0.001
    spacing = {step: planner.model.free_fraction(start, goal, margin_m=margin, step_rad=step) for step in (0.02, 0.005)}
    assert spacing[0.02] == 1.0 > spacing[0.005]
    assert planner._rounded(path, margin) is None
    assert replace(planner, model=planner.model.with_boxes([]))._rounded(path, margin) is not None


def test_the_same_seed_gives_the_same_path() -> None:
    start, goal, wall = _obstacle()
    first, second = (_planner(wall, seed=4).plan(start, goal) for _ in range(2))
    assert np.array_equal(first.positions_rad, second.positions_rad)
    assert np.array_equal(first.times_s, second.times_s)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_steps_are_left_out_only_where_every_one_of_them_is_free(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [
        CollisionBox(
            name=f"box{k}",
            parent_from_box=transform_rpy(rng.uniform([-0.8, -0.8, -0.3], [0.8, 0.8, 1.3]), rng.uniform(-1.5, 1.5, 3)),
            half_m=tuple(rng.uniform(0.01, 0.15, 3)),
        )
        for k in range(4)
    ]
    model = CollisionModel.build(KINEMATICS, TOOL, boxes)
    a, b = rng.uniform(-1.5, 1.5, (2, 6))
    count = int(np.ceil(np.max(np.abs(b - a)) / 0.02))
    expected = 1.0
    for k in range(1, count + 1):
        if not model.is_clear(a + (k / count) * (b - a), margin_m=0.008):
            expected = (k - 1) / count
            break
    assert model.free_fraction(a, b, margin_m=0.008, step_rad=0.02) == expected


def test_the_nearest_of_several_things_at_an_end_sets_the_margin() -> None:
    """With the gap of another one, which is larger, every way to the goal would count as blocked."""
    goal = np.array([0.5, 0.6, 0.4, 0.0, 0.6, 0.0])
    flange = KINEMATICS.flange(goal)
    path = KINEMATICS.follow_from(goal, [flange * transform_rpy((0.0, 0.0, -back), (0, 0, 0)) for back in (0.04, 0.08)])
    assert path is not None
    half = (0.02, 0.02, 0.005)
    beside = [
        CollisionBox(
            name=name,
            parent_from_box=flange * transform_rpy((side * (0.04 + gap + half[0]), 0.0, 0.12), (0, 0, 0)),
            half_m=half,
        )
        for name, side, gap in (("further", 1.0, 0.007), ("nearer", -1.0, 0.003))
    ]
    for boxes in (beside, beside[::-1]):
        planner = _planner(*boxes)
        assert planner.model.clearance_m(goal, enough_m=0.008) == pytest.approx(0.003, abs=1e-4)
        assert np.allclose(planner.plan(path[-1], goal).positions_rad[-1], goal)


def test_a_goal_inside_an_obstacle_is_unreachable_and_named() -> None:
    start, goal, _ = _obstacle()
    box = CollisionBox(
        name="cupboard",
        parent_from_box=transform_rpy(KINEMATICS.flange(goal).translation, (0, 0, 0)),
        half_m=(0.1, 0.1, 0.1),
    )
    with pytest.raises(Unreachable, match="cupboard"):
        _planner(box).plan(start, goal)


def make_panel() -> Panel:
    lights = [
        {"name": f"l{k}", "position_m": [x, y, 0.0]}
        for k, (x, y) in enumerate([(-0.2, 0.1), (0.2, 0.1), (0.2, -0.1), (-0.2, -0.1)])
    ]
    objects = [
        {
            "kind": "lever", "name": "valve", "position_m": [0.0, 0.0],
            "states": [{"name": "open", "angle_rad": 0.0}, {"name": "closed", "angle_rad": 1.5708}],
        },
        {
            "kind": "slider", "name": "fader", "position_m": [0.1, 0.0], "travel_m": 0.08, "angle_rad": 1.5708,
            "scale": {"minimum": 0.0, "maximum": 1.0, "unit": "", "at_min": -0.04, "at_max": 0.04},
        },
    ]  # fmt: skip
    data = {"schema": 1, "name": "p", "width_m": 0.5, "height_m": 0.3, "lights": lights, "objects": objects}
    return validate(data, Panel, source="test")


def test_the_envelope_of_a_lever_follows_its_angle() -> None:
    panel = make_panel()
    lever = panel.object("valve")
    assert isinstance(lever, Lever)
    sideways = envelope(lever, Shown(value=np.pi / 2))
    assert np.allclose(
        sideways.parent_from_box.as_matrix(),
        envelope(lever, Shown(state="closed")).parent_from_box.as_matrix(),
        atol=1e-5,
    )
    # A quarter turn clockwise from up points to +x.
    assert sideways.parent_from_box.translation[0] == pytest.approx(lever.length_m / 2)
    assert sideways.parent_from_box.translation[1] == pytest.approx(0.0, abs=1e-9)
    sweep = envelope(lever)
    assert sweep.half_m[0] > lever.length_m


def test_the_envelope_of_a_slider_covers_its_track() -> None:
    slider = make_panel().object("fader")
    assert isinstance(slider, Slider)
    box = envelope(slider)
    along = box.parent_from_box.rotation.apply([1, 0, 0])
    assert abs(along @ [0, 1, 0]) == pytest.approx(1.0)
    assert box.half_m[0] == pytest.approx((slider.travel_m + slider.cap_size_m[0]) / 2)


def test_a_slider_whose_value_is_known_blocks_only_the_place_of_its_cap() -> None:
    slider = make_panel().object("fader")
    assert isinstance(slider, Slider)
    box = envelope(slider, Shown(value=1.0))
    assert np.allclose(box.parent_from_box.translation[:2], [0.1, 0.04]), "its track points up"
    least = slider.cap_size_m[0] / 2
    assert least < box.half_m[0] < least + 0.05 * slider.travel_m
    assert envelope(slider, Shown(state="?")).half_m == envelope(slider).half_m


@pytest.mark.parametrize(("state", "side"), [("on", 1.0), ("off", -1.0)])
def test_a_toggle_in_a_known_state_blocks_only_the_side_of_its_bat(state: str, side: float) -> None:
    toggle = validate({"kind": "toggle", "name": "pump", "position_m": [0.0, 0.0]}, Toggle, source="test")
    whole, part = envelope(toggle), envelope(toggle, Shown(state=state))
    tip = side * toggle.bat_length_m * np.sin(toggle.tilt_rad)
    for y in (0.0, tip):
        assert abs(y - part.parent_from_box.translation[1]) + toggle.bat_radius_m <= part.half_m[1]
    other_edge = -tip - side * toggle.bat_radius_m
    assert abs(other_edge - part.parent_from_box.translation[1]) > part.half_m[1]
    assert part.half_m[1] < 0.8 * whole.half_m[1] and part.half_m[::2] == whole.half_m[::2]


def test_the_boxes_of_a_panel_move_with_it_and_the_plate_lies_behind_its_face() -> None:
    boxes = {box.name: box for box in placed(panel_boxes(make_panel()), transform_rpy((1.0, 0.0, 0.5), (0, 0, 0)))}
    assert set(boxes) == {"plate", "valve", "fader"}
    plate = boxes["plate"]
    assert plate.parent_from_box.translation[2] + plate.half_m[2] == pytest.approx(0.5)


def test_no_hand_fits_round_the_edge_of_the_plate() -> None:
    panel = make_panel()
    plate = next(box for box in panel_boxes(panel) if box.name == "plate")
    for side in (-1.0, 1.0):
        for beside in ((side * (panel.width_m / 2 + 0.1), 0.0, -0.03), (0.0, side * (panel.height_m / 2 + 0.1), -0.03)):
            local = plate.parent_from_box.inv().apply(np.array(beside))
            assert (np.abs(local) < plate.half_m).all(), "a finger tip beside the plate and behind its face"


def test_the_floor_stops_the_hand_but_not_the_foot() -> None:
    model = CollisionModel.build(KINEMATICS, TOOL, [floor_box(0.0)])
    assert model.is_clear(np.array([0.0, 0.2, 0.5, 0.0, 0.9, 0.0]), margin_m=0.01)
    low = np.array([0.0, 1.4, 0.6, 0.0, 0.5, 0.0])
    assert KINEMATICS.tool(low, identity()).translation[2] < 0.1
    assert not model.is_clear(low, margin_m=0.0)
