"""An instrument somewhere in an ordinary picture: found, told apart, read; several or none are refused with a reason."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.display_drawing import draw_photograph
from benchmarks.photograph_scenes import draw_scene, draw_without
from benchmarks.photographs import METER_NUMERAL, printed_way
from benchmarks.vision_dials import draw_dial
from benchmarks.vision_manometers import draw_manometer
from perception.vision import read_photograph
from perception.vision.photographs.anywhere import NOTHING
from perception.vision.photographs.faces import Face, find_faces
from perception.vision.photographs.numeral_scale import PrintedScale

SURE = 0.8
SCENES = range(700, 712)


def test_faces_are_found_where_they_are_drawn_also_aslant() -> None:
    found = 0
    for seed in SCENES:
        scene = draw_scene(seed, printed_way(seed))
        off = [np.hypot(*(face.middle - scene.middle_px)) / scene.width_px for face in find_faces(scene.image)]
        found += min(off, default=1.0) < 0.12
    assert found >= len(SCENES) - 2


def test_the_view_of_a_face_shows_a_circle_from_straight_ahead() -> None:
    picture = np.full((480, 640, 3), 90, np.uint8)
    cv2.ellipse(picture, (350, 200), (120, 85), 30.0, 0.0, 360.0, (235, 235, 230), -1, cv2.LINE_AA)
    (face,) = find_faces(picture)
    assert face.middle == pytest.approx([350, 200], abs=1.0)
    assert np.linalg.svd(face.rim)[1] == pytest.approx([120, 85], abs=1.5)
    view, image_from_view = face.view(picture)
    middle = (len(view) - 1) / 2
    assert (image_from_view @ [middle, middle, 1.0])[:2] == pytest.approx(face.middle, abs=0.5)
    bright = np.argwhere(view[:, :, 0] > 160)
    assert np.ptp(bright[:, 0]) == pytest.approx(np.ptp(bright[:, 1]), abs=4.0)


@pytest.mark.parametrize(("tilt_deg", "azimuth_deg"), [(20.0, 0.0), (35.0, 50.0), (48.0, 130.0), (40.0, 290.0)])
def test_one_of_the_guessed_pivots_is_where_perspective_shows_the_middle(tilt_deg: float, azimuth_deg: float) -> None:
    """A disc of 0.2 m at 0.5 m before a camera whose focal length is the side of its picture."""
    side_px, radius_m, away_m = 800, 0.1, 0.5
    axis = np.array([np.cos(np.deg2rad(azimuth_deg)), np.sin(np.deg2rad(azimuth_deg)), 0.0])
    turns = np.linspace(0.0, 2 * np.pi, 400)
    disc = radius_m * np.column_stack([np.cos(turns), np.sin(turns), np.zeros(400)])
    points = disc @ cv2.Rodrigues(np.deg2rad(tilt_deg) * axis)[0].T + [0.0, 0.0, away_m]
    outline = (side_px * points[:, :2] / points[:, 2:] + side_px / 2).astype(np.float32)
    middle, axes, turn_deg = cv2.fitEllipse(outline)
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    turned = np.array([[c, -s], [s, c]])
    face = Face(
        middle=np.array(middle), rim=turned @ np.diag(np.array(axes) / 2) @ turned.T, coverage=1.0, has_cap=True
    )
    pivot = np.linalg.solve(face.rim, np.full(2, side_px / 2) - face.middle)
    guesses = [one.pivot for one in face.otherwise(side_px)]
    assert guesses[0] == (0.0, 0.0) and len(guesses) == 3
    assert min(np.hypot(*np.subtract(guess, pivot)) for guess in guesses) < 0.03 < np.hypot(*pivot)
    assert face.is_steep == (tilt_deg >= 40.0)


def test_gauges_anywhere_are_read_with_their_kind_place_and_scale() -> None:
    right = wrong = 0
    for seed in SCENES:
        scene = draw_scene(seed, printed_way(seed))
        told = read_photograph(scene.image)
        if told.value is None:
            assert told.reason
            continue
        good = abs(told.value - scene.reading / 10 * scene.full) < 0.025 * scene.full
        assert good or told.confidence < SURE
        right, wrong = right + good, wrong + (not good)
        if good:
            assert told.scale is not None and 0.8 * scene.full < told.scale.maximum <= scene.full  # of its numbers
            assert (
                told.face is not None
                and np.hypot(*np.subtract(told.face.middle, scene.middle_px)) < 0.12 * scene.width_px
            )
    assert right >= 3 and wrong <= 1


@pytest.mark.parametrize("seed", [942028, 942032])
def test_what_else_is_round_is_no_instrument_beside_one_with_numerals(seed: int) -> None:
    """Told the scale, a flange with a bolt or a handwheel's spoke would be read, too."""
    scene = draw_scene(seed, printed_way(seed))
    told = read_photograph(scene.image, scale=(0.0, scene.full))
    assert told.value == pytest.approx(scene.reading / 10 * scene.full, abs=0.025 * scene.full)
    assert told.scale is not None and told.scale.by_numerals


def test_what_is_seen_steeply_is_never_sure() -> None:
    """Read at .93 and wrong by 4 % of the scale."""
    scene = draw_scene(943004, printed_way(943004))
    told = read_photograph(scene.image, scale=(0.0, scene.full))
    assert told.confidence < SURE


def test_where_no_instrument_is_none_is_read() -> None:
    for seed in range(720, 728):
        told = read_photograph(draw_without(seed))
        assert told.confidence < SURE and (told.reason is None) == (told.value is not None)
    assert read_photograph(np.full((200, 300, 3), 120, np.uint8)).reason == NOTHING


def test_two_instruments_are_refused_with_their_places() -> None:
    both = []
    for seed in (995000, 995005):
        gauge = cv2.resize(draw_manometer(seed, printed_way(seed)).image, (400, 400))
        both.append(cv2.copyMakeBorder(gauge, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=(90, 90, 90)))
        assert read_photograph(both[-1]).confidence > 0.7
    told = read_photograph(np.hstack(both))
    assert not told.answered and told.reason is not None and "2 instruments" in told.reason and "pixel" in told.reason


def test_a_display_is_told_from_a_face() -> None:
    drawn = draw_photograph(3, "cropped")
    told = read_photograph(drawn.image)
    assert told.text == drawn.text and told.face is None


def test_a_full_turn_is_read_by_its_numerals() -> None:
    read = 0
    for seed in range(200000, 200012):
        drawn = draw_dial(seed, circular=True, numeral=METER_NUMERAL)
        told = read_photograph(drawn.image)
        if told.value is None:
            continue
        off = abs(told.value - drawn.reading) % 10.0
        assert min(off, 10.0 - off) < 0.3 or told.confidence < SURE
        read += told.scale is not None and told.scale.maximum == 10.0
    assert read >= 2


@pytest.mark.parametrize(
    ("ends", "turn"),
    [((0.0, 9.0, 0.0, 324.0), 10.0), ((1.0, 9.0, -36.0, -324.0), -10.0), ((0.0, 9.0, -135.0, 135.0), None)],
)
def test_a_scale_that_closes_is_a_full_turn(ends: tuple[float, ...], turn: float | None) -> None:
    low, high, first, last = ends
    scale = PrintedScale(
        minimum=low, maximum=high, at_min=np.deg2rad(first), at_max=np.deg2rad(last), step=1.0, off=0.7, numbers=9, lacking=0
    )  # fmt: skip
    assert scale.full_turn() == turn
