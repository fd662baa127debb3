"""Looks that were taught from noisy images count in noisy images only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.vision_disturbance import Disturbance
from perception.vision.finding.blind import chosen, lay_out, uprightness
from perception.vision.finding.features import PLATE_PX_PER_M, Ground, look_at, plate_gray
from perception.vision.finding.match import distances
from perception.vision.finding.shapes import find_edges
from perception.vision.knowledge import Knowledge, TaughtKind, spread_of
from perception.vision.knowledge_files import load_knowledge, write_kind
from perception.vision.look import GROUPS, LENGTH, RADII_M
from perception.vision.projection import PlateProjection
from perception.vision.teaching.lesson import example_at, overview_of, teach_example
from tests.perception.vision.bench_panel import panel
from tests.perception.vision.finding.test_blind import PLATE, overview, pixel_of


def _with_noisy_look(knowledge: Knowledge, name: str, look: np.ndarray) -> Knowledge:
    return knowledge.grown(TaughtKind(name=name, size_m=(0.05, 0.05), looks=look[None], noisy=np.array([True])))


def test_looks_of_noisy_images_survive_their_files_and_say_nothing_of_the_spread(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    kinds = (TaughtKind(name="a", size_m=(0.05, 0.04), looks=np.round(rng.normal(0, 1, (3, LENGTH)), 2)),)
    knowledge = _with_noisy_look(Knowledge(kinds=kinds, spread=spread_of(kinds)), "a", np.full(LENGTH, 9.0))
    write_kind(knowledge.kinds[0], tmp_path)
    loaded = load_knowledge(tmp_path)
    (good,), (noisy,) = loaded.for_image(noisy=False).kinds, loaded.for_image(noisy=True).kinds
    assert good.noisy is None and np.allclose(good.looks, kinds[0].looks)
    assert noisy.noisy is not None and noisy.noisy.tolist() == [False, False, False, True]
    assert np.allclose(loaded.spread, knowledge.spread)
    assert loaded.for_image(noisy=False) is loaded.for_image(noisy=False), "prepared once"


def test_a_kind_of_noisy_images_only_is_no_kind_elsewhere() -> None:
    known = Knowledge(
        kinds=(TaughtKind(name="a", size_m=(0.05, 0.04), looks=np.zeros((1, LENGTH))),), spread=np.ones(LENGTH)
    )
    grown = _with_noisy_look(known, "ghost", np.ones(LENGTH))
    assert [kind.name for kind in grown.for_image(noisy=False).kinds] == ["a"]
    assert [kind.name for kind in grown.for_image(noisy=True).kinds] == ["a", "ghost"]


@pytest.mark.parametrize(("sigma", "noisy"), [(0.5, False), (4.0, True)])
def test_only_a_noisy_image_is_compared_with_looks_of_noisy_images(sigma: float, noisy: bool) -> None:
    image, view = overview(disturbance=Disturbance(noise_sigma=sigma))
    ground = lay_out(image, view, PLATE)
    at = (np.array(panel().object("mode").point_m[:2]) * [1.0, -1.0] + np.array(PLATE) / 2) * PLATE_PX_PER_M
    look = look_at(ground, at)
    knowledge = _with_noisy_look(load_knowledge(), "ghost", look[0])
    found = chosen(ground, at[None], look, knowledge, view, PLATE)
    assert ground.noisy is noisy
    assert any(candidate.kind == "ghost" for candidate in found) is noisy


@pytest.mark.parametrize(("noisy", "named"), [(False, "chance"), (True, "often")])
def test_one_look_that_is_near_by_chance_names_nothing_in_a_noisy_image(noisy: bool, named: str) -> None:
    picture = np.full((300, 400), 150, np.uint8)
    cv2.circle(picture, (200, 150), 30, 60, -1)
    edges, level = find_edges(picture), plate_gray(picture)
    ground = Ground(picture=picture.astype(np.float32), edges=edges, plate_gray=level, noisy=noisy)
    place = np.array([[200.0, 150.0]])
    look = look_at(ground, place)
    off = {"chance": (0.0, 0.6, 0.6), "often": (0.1, 0.1, 0.1)}
    kinds = tuple(TaughtKind(name=n, size_m=(0.04, 0.04), looks=look + np.array(by)[:, None]) for n, by in off.items())
    view = PlateProjection(px_from_plate=np.diag([PLATE_PX_PER_M, -PLATE_PX_PER_M, 1.0]), corners_m=np.zeros((4, 2)))
    plate_m = (400 / PLATE_PX_PER_M, 300 / PLATE_PX_PER_M)
    (found,) = chosen(ground, place, look, Knowledge(kinds=kinds, spread=np.ones(LENGTH)), view, plate_m)
    assert (found.kind, found.reason) == (named, None)


def test_noise_says_nothing_of_which_way_is_up() -> None:
    image, view = overview()
    ground, knowledge = lay_out(image, view, PLATE), load_knowledge()
    at = (
        np.array([panel_object.point_m[:2] for panel_object in panel().objects]) * [1.0, -1.0] + np.array(PLATE) / 2
    ) * PLATE_PX_PER_M
    found = chosen(ground, at, look_at(ground, at), knowledge, view, PLATE)
    up = uprightness(ground, found, knowledge, PLATE)
    noisy = replace(ground, noisy=True)
    ghosts = [replace(candidate, kind="ghost") for candidate in found]
    with_ghost = _with_noisy_look(knowledge, "ghost", np.zeros(LENGTH))
    assert up > 0.0
    assert uprightness(noisy, found, knowledge, PLATE) == up
    assert uprightness(noisy, ghosts, with_ghost, PLATE) == 0.0


def test_what_lies_far_from_a_middle_counts_in_good_images_only() -> None:
    known = Knowledge(
        kinds=(TaughtKind(name="a", size_m=(0.05, 0.04), looks=np.zeros((1, LENGTH))),), spread=np.ones(LENGTH)
    )
    rows = np.zeros((2, len(GROUPS), len(RADII_M)))
    rows[0, :, RADII_M > 0.036] = rows[1, :, RADII_M < 0.03] = 1.0
    looks = np.zeros((2, LENGTH))
    looks[:, : rows[0].size] = rows.reshape(2, -1)
    far, near = distances(looks, known.for_image(noisy=True))[:, 0]
    assert far == 0.0 < near
    assert (distances(looks, known.for_image(noisy=False)) > 0.0).all()


def test_looks_of_noisy_images_refuse_no_lesson_of_a_good_one() -> None:
    image, view = overview()
    example = example_at(overview_of(image, plate_m=PLATE), [pixel_of(view, "emergency")])
    others = load_knowledge()
    twice = _with_noisy_look(_with_noisy_look(others, "ghost", example.look), "ghost", example.look + 1.0)
    assert not example.noisy
    assert teach_example(example, twice, kind="mushroom").added
    assert teach_example(example, _with_noisy_look(others, "mushroom", example.look), kind="mushroom").added
