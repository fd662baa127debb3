"""Tests of blind recognition and teaching on drawn scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.vision_disturbance import Disturbance
from hal.errors import Ambiguous, InvalidRequest, NotFound
from perception.vision.finding.blind import chosen, recognise
from perception.vision.finding.features import PLATE_PX_PER_M, Ground, half_turned, look_at, plate_gray
from perception.vision.finding.match import CLIP, NEXT_FURTHER, distances, nearest, nearest_of, prepared
from perception.vision.finding.plate import TYPICAL_FOCAL, find_plate
from perception.vision.finding.shapes import find_edges
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind, spread_of
from perception.vision.knowledge_files import load_knowledge, write_kind
from perception.vision.look import (
    AROUND_GROUPS,
    DIRECTIONS,
    GROUPS,
    LENGTH,
    RADII_M,
    RINGS,
    WEIGHTS,
    numbers_within,
)
from perception.vision.projection import CameraProjection, PlateProjection
from perception.vision.teaching.lesson import check, plate_points, teach
from tests.perception.vision.bench_panel import panel, scene

PLATE = (0.60, 0.40)
CORNERS_M = np.array([[-0.3, 0.2], [0.3, 0.2], [0.3, -0.2], [-0.3, -0.2]])


def overview(**options: object) -> tuple[np.ndarray, CameraProjection]:
    image, intrinsics, pose = scene(tilt_deg=5.0, distance_m=0.66, pose_error=0.0, **options)
    return image, CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)


def pixel_of(view: CameraProjection, name: str) -> tuple[float, float]:
    u, v = view.project([panel().object(name).point_m])[0]
    return float(u), float(v)


def test_the_plate_is_found_to_a_pixel_or_two() -> None:
    image, view = overview()
    plate = find_plate(image, *PLATE)
    assert plate is not None and all(plate.sides_seen)
    corners = np.column_stack([plate.view.corners_m, np.zeros(4)])
    assert np.linalg.norm(plate.view.project(corners) - view.project(corners), axis=1).max() < 2.0


@pytest.mark.parametrize("tilt_deg", [15.0, 30.0])
@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 200.0])
def test_a_plate_tilted_before_a_lens_that_is_not_typical_is_found(tilt_deg: float, azimuth_deg: float) -> None:
    image, intrinsics, pose = scene(
        tilt_deg=tilt_deg, azimuth_deg=azimuth_deg, distance_m=0.85, pose_error=0.0, size=(640, 480)
    )
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    plate = find_plate(image, *PLATE)
    assert plate is not None and intrinsics.fx_px < 0.85 * TYPICAL_FOCAL * 640
    corners = np.column_stack([plate.view.corners_m, np.zeros(4)])
    assert np.linalg.norm(plate.view.project(corners) - view.project(corners), axis=1).max() < 1.5


def test_a_plate_that_the_image_cuts_off_is_completed() -> None:
    image, view = overview()
    cut = np.ascontiguousarray(image[:, :1060])
    plate = find_plate(cut, *PLATE, focal_px=1280.0)
    assert plate is not None and not plate.sides_seen[1]
    corners = np.column_stack([plate.view.corners_m, np.zeros(4)])
    assert np.linalg.norm(plate.view.project(corners) - view.project(corners), axis=1).max() < 60.0


@pytest.mark.parametrize("roll_deg", [0.0, 2.0])
def test_a_plate_that_fills_the_image_but_for_one_side_is_found(roll_deg: float) -> None:
    image, view = overview()
    corners_m = np.column_stack([CORNERS_M, np.zeros(4)])
    turn = cv2.getRotationMatrix2D((640.0, 480.0), roll_deg, 1.0)
    turned = cv2.warpAffine(image, turn, (1280, 960), borderMode=cv2.BORDER_REPLICATE)
    corners_px = view.project(corners_m) @ turn[:, :2].T + turn[:, 2]
    low, high = np.round(corners_px.min(axis=0)).astype(int), np.round(corners_px.max(axis=0)).astype(int)
    first = low - [40, -4]  # the left side is visible, the other three are cut off or at the border of the image
    cut = np.ascontiguousarray(turned[first[1] : high[1] - 4, first[0] : high[0] - 4])
    plate = find_plate(cut, *PLATE, focal_px=1280.0)
    assert plate is not None and plate.sides_seen[3]
    off = plate.view.project(corners_m) - (corners_px - first)
    assert np.linalg.norm(off, axis=1).max() < 0.04 * cut.shape[1]


def test_one_edge_alone_is_no_plate() -> None:
    horizon = np.full((480, 640), 60, np.uint8)
    horizon[150:] = 190
    assert find_plate(horizon, *PLATE) is None


def test_a_picture_without_a_plate_is_refused() -> None:
    noise = np.random.default_rng(3).integers(0, 40, (240, 320), dtype=np.uint8)
    noise[100:110, 100:110] = 200
    with pytest.raises(NotFound):
        recognise(noise, load_knowledge())


def test_a_kind_that_did_not_exist_is_taught_by_two_clicks_and_found_again() -> None:
    knowledge = load_knowledge()
    assert knowledge.kind("mushroom") is None
    image, view = overview()
    (u, v), radius_px = pixel_of(view, "emergency"), 46.0
    clicks = [(u - radius_px, v - radius_px), (u + radius_px, v + radius_px)]
    lesson = teach(image, knowledge, kind="mushroom", clicks_px=clicks, plate_m=PLATE)
    assert lesson.is_new_kind and lesson.added
    other, other_view = overview(disturbance=Disturbance(exposure=0.8, slope_ratio=1.5, seed=9), seed=4)
    found = [c for c in check(other, lesson.knowledge, plate_m=PLATE) if c.kind == "mushroom" and c.reason is None]
    assert len(found) == 1
    assert np.linalg.norm(found[0].centre_px - pixel_of(other_view, "emergency")) < 12.0


def test_teaching_the_same_look_again_teaches_nothing() -> None:
    image, view = overview()
    first = teach(
        image,
        load_knowledge(),
        kind="mushroom",
        clicks_px=[pixel_of(view, "emergency")],
        size_m=(0.04, 0.04),
        plate_m=PLATE,
    )
    again = teach(image, first.knowledge, kind="mushroom", clicks_px=[pixel_of(view, "emergency")], plate_m=PLATE)
    assert not again.added and again.knowledge is first.knowledge


def test_a_look_that_would_rob_another_kind_is_refused() -> None:
    knowledge = load_knowledge()
    gauge = knowledge.kind("gauge")
    assert gauge is not None
    image, view = overview()
    twin = teach(
        image,
        knowledge,
        kind="pressure_dial",
        clicks_px=[pixel_of(view, "pressure")],
        size_m=(0.08, 0.08),
        plate_m=PLATE,
    )
    look = twin.kind.looks[0]
    filled = TaughtKind(name="gauge", size_m=gauge.size_m, looks=np.vstack([gauge.looks, look + 0.01]))
    crowded = Knowledge(
        kinds=tuple(filled if k.name == "gauge" else k for k in knowledge.kinds), spread=knowledge.spread
    )
    with pytest.raises(Ambiguous):
        teach(
            image,
            crowded,
            kind="pressure_dial",
            clicks_px=[pixel_of(view, "pressure")],
            size_m=(0.08, 0.08),
            plate_m=PLATE,
        )


def test_clicks_are_checked() -> None:
    image, view = overview()
    with pytest.raises(InvalidRequest):
        teach(image, load_knowledge(), kind="gauge", clicks_px=[], plate_m=PLATE)
    with pytest.raises(NotFound):
        plate_points(view, [(2.0, 2.0)], PLATE)


def test_knowledge_survives_its_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    kinds = tuple(
        TaughtKind(name=name, size_m=(0.05, 0.04), looks=np.round(rng.normal(0, 1, (3, LENGTH)), 2))
        for name in ("a", NOTHING)
    )
    for kind in kinds:
        write_kind(kind, tmp_path)
    loaded = load_knowledge(tmp_path)
    for kind in kinds:
        again = loaded.kind(kind.name)
        assert again is not None and again.size_m == kind.size_m
        assert np.allclose(again.looks, kind.looks)


def test_a_look_written_without_directions_is_the_same_all_around(tmp_path: Path) -> None:
    row = list(range(len(RADII_M)))
    rows = "\n".join(f"{name} = {row}" for name in GROUPS)
    (tmp_path / "disc.toml").write_text(f'name = "disc"\nwidth_m = 0.05\nheight_m = 0.05\n[[looks]]\n{rows}\n')
    look = load_knowledge(tmp_path).kinds[0].looks[0]
    around = look[len(GROUPS) * len(RADII_M) :].reshape(len(AROUND_GROUPS), DIRECTIONS, RINGS)
    assert np.allclose(around, (2 * np.arange(RINGS) + 0.5) / 100)


def test_a_disc_looks_the_same_from_all_directions_and_a_bar_does_not() -> None:
    looks = {}
    for name in ("disc", "bar"):
        picture = np.full((200, 200), 150, np.uint8)
        if name == "disc":
            cv2.circle(picture, (100, 100), 30, 60, -1)
        else:
            cv2.rectangle(picture, (40, 90), (160, 110), 60, -1)
        ground = Ground(picture=picture.astype(np.float32), edges=find_edges(picture), plate_gray=plate_gray(picture))
        gray, edge = look_at(ground, [(100, 100)])[0][len(GROUPS) * len(RADII_M) :].reshape(2, DIRECTIONS, RINGS)
        looks[name] = gray, edge
    assert np.ptp(looks["disc"][0], axis=0).max() < 0.1
    up, right = looks["bar"][0][0], looks["bar"][0][2]
    assert (right[2:5] < -0.3).all() and (up[2:5] > -0.05).all()


def test_what_is_as_much_like_one_kind_as_another_is_refused_by_name() -> None:
    picture = np.full((300, 400), 150, np.uint8)
    cv2.circle(picture, (200, 150), 30, 60, -1)
    ground = Ground(picture=picture.astype(np.float32), edges=find_edges(picture), plate_gray=plate_gray(picture))
    place = np.array([[200.0, 150.0]])
    look = look_at(ground, place)
    plate_m = (400 / PLATE_PX_PER_M, 300 / PLATE_PX_PER_M)
    view = PlateProjection(px_from_plate=np.diag([PLATE_PX_PER_M, -PLATE_PX_PER_M, 1.0]), corners_m=np.zeros((4, 2)))
    near, far = (TaughtKind(name=name, size_m=(0.04, 0.04), looks=look + off) for name, off in (("a", 0.0), ("b", 1.5)))
    twin = TaughtKind(name="b", size_m=(0.04, 0.04), looks=look + 0.001)
    spread = np.ones(LENGTH)
    (clear,) = chosen(ground, place, look, Knowledge(kinds=(near, far), spread=spread), view, plate_m)
    (doubtful,) = chosen(ground, place, look, Knowledge(kinds=(near, twin), spread=spread), view, plate_m)
    assert clear.reason is None and clear.kind == "a" and clear.confidence > 0.99
    assert doubtful.reason is not None and "a b" in doubtful.reason and doubtful.rival[0] == "b"


def distances_reference(looks: np.ndarray, knowledge: Knowledge, *, mean_of: int = 1) -> np.ndarray:
    """Compute `distances`, or `nearest` with `mean_of`, in plain numpy."""
    columns = []
    for kind in knowledge.kinds:
        difference = np.abs(looks[:, None] - kind.looks[None]) / knowledge.spread
        near = np.sort(np.average(np.minimum(difference, CLIP), axis=2, weights=knowledge.weights), axis=1)[:, :mean_of]
        lacking = np.arange(1, mean_of - near.shape[1] + 1)
        columns.append(np.hstack([near, near[:, -1:] + NEXT_FURTHER * lacking]).mean(axis=1))
    return np.column_stack(columns)


def test_the_fast_match_agrees_with_the_plain_one() -> None:
    rng = np.random.default_rng(1)
    kinds = tuple(
        TaughtKind(name=name, size_m=(0.05, 0.04), looks=rng.normal(0, 1, (n, LENGTH)))
        for name, n in (("a", 4), ("b", 7))
    )
    knowledge = Knowledge(kinds=kinds, spread=spread_of(kinds))
    looks = rng.normal(0, 1, (9, LENGTH))
    for known in (knowledge, knowledge.for_image(noisy=True)):
        assert np.allclose(distances(looks, known), distances_reference(looks, known))
        for mean_of in (3, 6):  # one kind has only four looks
            plain = distances_reference(looks, known, mean_of=mean_of)
            assert np.allclose(nearest(looks, prepared(known), mean_of=mean_of), plain)


def test_numbers_beyond_the_reach_of_a_look_do_not_count() -> None:
    rng = np.random.default_rng(2)
    looks = rng.normal(0, 1, (3, LENGTH))
    reach_m = np.array([0.012, np.inf, 0.03])
    kind = TaughtKind(name="a", size_m=(0.05, 0.04), looks=looks, reach_m=reach_m)
    other = TaughtKind(name="b", size_m=(0.05, 0.04), looks=rng.normal(0, 1, (2, LENGTH)))
    known = Knowledge(kinds=(kind, other, kind.of(np.array([2]))), spread=spread_of((kind, other)))
    seen = np.where(numbers_within(0.012), looks[0], rng.normal(0, 1, LENGTH))
    alone = [Knowledge(kinds=(replace(kind.of(np.array([k])), reach_m=None),), spread=known.spread) for k in range(3)]
    within = [replace(one, weights=WEIGHTS * numbers_within(reach)) for one, reach in zip(alone, reach_m, strict=True)]
    expected = [float(distances_reference(seen[None], one)[0, 0]) for one in within]
    assert expected[0] == 0.0
    assert distances(seen[None], known)[0, [0, 2]] == pytest.approx([0.0, expected[2]], abs=1e-6)
    assert nearest_of(np.tile(seen, (2, 1)), prepared(known), np.array([2, 0])) == pytest.approx(
        [expected[2], 0.0], abs=1e-6
    )


def test_looks_of_a_turned_picture_are_the_turned_looks() -> None:
    gray = np.random.default_rng(0).integers(40, 220, (301, 401)).astype(np.uint8)
    picture = np.asarray(cv2.GaussianBlur(gray, (0, 0), 3.0), np.uint8)
    places = np.array([[120.0, 130.0], [250.0, 170.0]])
    looks = []
    for shown, at in ((picture, places), (picture[::-1, ::-1].copy(), [400.0, 300.0] - places)):
        plain = np.full(shown.shape, 120.0, np.float32)
        looks.append(look_at(Ground(picture=shown.astype(np.float32), edges=find_edges(shown), plate_gray=plain), at))
    assert np.abs(half_turned(looks[0]) - looks[1]).mean() < 0.01
    assert np.abs(looks[0] - looks[1]).mean() > 0.02


OVERVIEWS = Path(__file__).resolve().parents[5] / "shared" / "data" / "vision" / "synth_dev"


@pytest.mark.skipif(not OVERVIEWS.exists(), reason="no overviews beside the repository")
@pytest.mark.parametrize("name", ["p21_000", "p24_020"])
def test_a_panel_upside_down_is_refused(name: str) -> None:
    gray = cv2.imread(str(OVERVIEWS / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    upright = np.asarray(gray, np.uint8)
    knowledge = load_knowledge()
    assert recognise(upright, knowledge)
    with pytest.raises(NotFound, match="upside down"):
        recognise(np.ascontiguousarray(upright[::-1, ::-1]), knowledge)


@pytest.mark.parametrize("quarters", [1, 3])
def test_a_panel_turned_by_a_quarter_is_no_plate_of_its_size(quarters: int) -> None:
    image, _ = overview()
    assert recognise(image, load_knowledge(), plate_m=PLATE)
    with pytest.raises(NotFound, match="no plate"):
        recognise(np.ascontiguousarray(np.rot90(image, quarters)), load_knowledge(), plate_m=PLATE)


def test_two_panels_are_ambiguous_blind_too() -> None:
    image, _ = overview()
    with pytest.raises(Ambiguous, match="two panels"):
        recognise(np.ascontiguousarray(np.hstack([image, image])), load_knowledge(), plate_m=PLATE)


def test_a_border_that_neither_edges_nor_objects_confirm_is_no_plate() -> None:
    bare = np.full((480, 640), 60, np.uint8)
    bare[100:, 120:] = 170  # a corner of something large
    plate = find_plate(bare, *PLATE)
    assert plate is not None and not plate.is_sure
    with pytest.raises(NotFound, match="not confirmed"):
        recognise(bare, load_knowledge(), plate_m=PLATE)
    bare[400:], bare[:, 570:] = 60, 60
    whole = find_plate(bare, *PLATE)
    assert whole is not None and whole.is_sure
    assert not any(c.reason is None for c in recognise(bare, load_knowledge(), plate_m=PLATE))


@pytest.mark.skipif(not OVERVIEWS.exists(), reason="no overviews beside the repository")
def test_a_close_up_of_one_object_is_not_taken_for_a_panel() -> None:
    for file in sorted(OVERVIEWS.glob("p22_*.png")):
        gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        with pytest.raises(NotFound):
            recognise(np.asarray(gray, np.uint8), load_knowledge())
