"""Tests of teaching looks from a known panel: blind recognition before and after, and images that teach nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.errors import NotFound
from hal.geometry import UncertainPose, perturbed
from hal.panel import Lamp, Panel
from perception.vision.finding.blind import Detection, recognise
from perception.vision.knowledge import NOTHING, Knowledge
from perception.vision.knowledge_files import load_knowledge, write_kind
from perception.vision.projection import CameraProjection
from perception.vision.teaching.from_panel import PanelLooks, teach_from_panel
from perception.vision.teaching.lesson import example_in, surroundings, teach_example
from tests.perception.vision.bench_panel import panel, scene

PLATE_M = (0.60, 0.40)


def learned(known_panel: Panel, **more: float) -> PanelLooks:
    image, intrinsics, pose = scene(tilt_deg=4.0, distance_m=0.66, **more)
    return teach_from_panel(
        image, CameraProjection(intrinsics=intrinsics, camera_from_panel=pose), known_panel, load_knowledge()
    )


@pytest.fixture(scope="module")
def lesson() -> PanelLooks:
    return learned(panel())


def right(knowledge: Knowledge) -> tuple[set[str], list[Detection]]:
    """Return the objects found in another overview with other states, and the accepted candidates."""
    image, _, _ = scene(
        tilt_deg=11.0, azimuth_deg=200.0, distance_m=0.7, shown={"pressure": 2.0, "mode": "low", "drain": -0.4}, seed=5
    )
    given = [c for c in recognise(image, knowledge, plate_m=PLATE_M) if c.reason is None]
    names = {
        panel_object.name
        for panel_object in panel().objects
        for c in given
        if c.kind == panel_object.kind
        and np.linalg.norm(c.centre_m - panel_object.position_m)
        < max((panel_object.face.half_width_m, panel_object.face.half_height_m))
    }
    return names, given


def test_what_one_overview_taught_is_found_in_another(lesson: PanelLooks) -> None:
    before, _ = right(load_knowledge())
    now, given = right(lesson.knowledge)
    assert "emergency" not in before and "emergency" in now
    assert len(now) >= len(panel().objects) - 1 and len(now) >= len(before)
    assert len(given) == len(now), "nothing is named that is not there"


def test_an_object_is_found_after_its_surroundings_in_one_image_taught_it() -> None:
    image, intrinsics, pose = scene(tilt_deg=4.0, distance_m=0.62)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    button = panel().object("emergency")
    picture = surroundings(image, view, button.point_m, view.project([button.point_m])[0])
    assert picture is not None
    taught = teach_example(example_in(picture), load_knowledge(), kind="mushroom")
    assert (taught.is_new_kind, taught.added) == (True, True)
    before, given_before = right(load_knowledge())
    now, given = right(taught.knowledge)
    assert now == before | {"emergency"} and len(given) == len(given_before) + 1, "no other name is new"
    assert surroundings(image, view, [0.29, 0.19, 0.0], [np.nan, np.nan]) is None, "the image does not show all of it"


def test_the_lesson_says_what_it_did(lesson: PanelLooks) -> None:
    assert lesson.added["mushroom"] == 1 and lesson.added[NOTHING] > 0
    assert {kind.name for kind in lesson.kinds} == set(lesson.added)
    assert [each.panel_object.name for each in lesson.shown] == [panel_object.name for panel_object in panel().objects]
    assert set(lesson.known_before) < set(lesson.known_now) and not lesson.left_out
    shipped = load_knowledge()
    for kind in lesson.knowledge.kinds:
        known = shipped.kind(kind.name)
        assert len(kind.looks) == lesson.added.get(kind.name, 0) + (0 if known is None else len(known.looks))


def test_the_same_overview_teaches_nothing_twice(lesson: PanelLooks) -> None:
    image, intrinsics, pose = scene(tilt_deg=4.0, distance_m=0.66)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    assert teach_from_panel(image, view, panel(), lesson.knowledge).added == {}


def test_the_pose_need_not_be_exact(lesson: PanelLooks) -> None:
    off = learned(panel(), pose_error=2.0)
    assert off.known_now == lesson.known_now


def test_an_object_that_is_not_there_teaches_nothing_and_its_place_is_not_nothing() -> None:
    ghost = Lamp(name="ghost", position_m=(0.13, -0.15), radius_m=0.010)
    taught = learned(panel().model_copy(update={"objects": (*panel().objects, ghost)}))
    assert list(taught.left_out) == ["ghost"] and "bare plate" in taught.left_out["ghost"]
    assert "ghost" not in taught.known_now and len(taught.shown) == len(panel().objects)


def test_a_panel_that_is_not_where_the_pose_has_it_teaches_nothing() -> None:
    image, intrinsics, pose = scene(tilt_deg=4.0, distance_m=0.66)
    elsewhere = UncertainPose(
        parent_from_child=perturbed(pose.parent_from_child, np.array([0.06, 0.05, 0.0, 0.0, 0.0, 0.2])),
        covariance=pose.covariance,
    )
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=elsewhere)
    with pytest.raises(NotFound, match="does not show panel"):
        teach_from_panel(image, view, panel(), load_knowledge())


def test_a_panel_of_which_most_is_elsewhere_teaches_nothing() -> None:
    """Otherwise the looks of arbitrary places would be taught."""
    bare = [(-0.26 + 0.04 * k, 0.06) for k in range(14)]
    more = [Lamp(kind="lamp", name=f"lamp_{k}", position_m=place, radius_m=0.01) for k, place in enumerate(bare)]
    other = panel().model_copy(update={"objects": (*panel().objects, *more)})
    with pytest.raises(NotFound, match="of the 26 objects"):
        learned(other)


def test_what_is_written_is_what_was_learned(lesson: PanelLooks, tmp_path: Path) -> None:
    for kind in lesson.kinds:
        write_kind(kind, tmp_path)
    for kind in load_knowledge(tmp_path).kinds:
        made = lesson.knowledge.kind(kind.name)
        assert made is not None
        np.testing.assert_array_equal(kind.looks, made.looks)


def test_looks_are_added_once_and_new_names_make_new_kinds(lesson: PanelLooks) -> None:
    shipped = load_knowledge()
    grown = shipped.with_looks_of(lesson.kinds)
    assert {kind.name: len(kind.looks) for kind in grown.kinds} == {
        kind.name: len(kind.looks) for kind in lesson.knowledge.kinds
    }
    assert grown.with_looks_of(lesson.kinds).kinds[0].looks.shape == grown.kinds[0].looks.shape
    np.testing.assert_array_equal(grown.spread, shipped.spread)
