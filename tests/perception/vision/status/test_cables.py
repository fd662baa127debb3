"""Cables across round faces and levers: what they hide is known, and they are not taken for pointers or handles."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.display_drawing import draw_taught
from benchmarks.display_report import read_case
from benchmarks.panel_scene import draw_scene
from benchmarks.vision_held_out import found_blind, read_scene
from hal.panel import Gauge, Lamp, Lever, Scale, Slider, State
from perception.vision.patch import Patch
from perception.vision.status.bar import bar_contrast
from perception.vision.status.digit_grid import DigitGrid
from perception.vision.status.gauge import read_gauge, status_of_pointer
from perception.vision.status.lamp import read_lamp
from perception.vision.status.lever import read_lever
from perception.vision.status.occluder_bands import cables_across
from perception.vision.status.panel_meter import RIVAL, SIGMA_RAD
from perception.vision.status.pointer import PointerFit
from perception.vision.status.slider import read_slider
from perception.vision.status.stray import stray_ink

SIZE, PX_PER_M, RADIUS_M = 240, 3000.0, 0.031
MIDDLE = SIZE // 2
SLIDER = Slider(
    kind="slider", name="s", position_m=(0.0, 0.0), angle_rad=0.0, travel_m=0.04, cap_size_m=(0.018, 0.02, 0.0001),
    scale=Scale(minimum=0.0, maximum=100.0, unit="%", at_min=-0.02, at_max=0.02),
)  # fmt: skip
SCALE = Scale(minimum=0.0, maximum=10.0, unit="bar", at_min=-np.deg2rad(135.0), at_max=np.deg2rad(135.0))
GAUGE = Gauge(kind="gauge", name="g", position_m=(0.0, 0.0), radius_m=RADIUS_M, scale=SCALE)
LEVER = Lever(
    kind="lever", name="inlet", position_m=(0.0, 0.0), length_m=0.029, width_m=0.008,
    states=(State(name="closed", angle_rad=0.0), State(name="open", angle_rad=float(np.pi / 2))),
)  # fmt: skip


def patch_of(picture: NDArray[np.uint8], noise: float = 1.5) -> Patch:
    rough = np.random.default_rng(0).normal(0.0, noise, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.2) + rough), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([MIDDLE, MIDDLE], float), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


def towards(angle_rad: float, reach_px: float) -> tuple[int, int]:
    return round(MIDDLE + reach_px * np.sin(angle_rad)), round(MIDDLE - reach_px * np.cos(angle_rad))


def dark_face(value: float) -> NDArray[np.uint8]:
    """Draw a black gauge with a white pointer on a bright plate."""
    picture = np.full((SIZE, SIZE), 170, np.uint8)
    cv2.circle(picture, (MIDDLE, MIDDLE), round(RADIUS_M * PX_PER_M), 30, -1, cv2.LINE_AA)
    angle = SCALE.place_of(value)
    cv2.line(picture, towards(angle, -15), towards(angle, 68), 230, 5, cv2.LINE_AA)
    return picture


def hung(picture: NDArray[np.uint8], xs: tuple[int, int, int], gray: int) -> NDArray[np.uint8]:
    """Draw a cable from top to bottom with a bend, through three columns."""
    points = np.array([[xs[0], -5], [xs[1], MIDDLE], [xs[2], SIZE + 5]])
    cv2.polylines(picture, [points], False, gray, 12, cv2.LINE_AA)
    return picture


@pytest.mark.parametrize("xs", [(80, 90, 82), (150, 185, 140), (70, 112, 150)])
@pytest.mark.parametrize("value", [5.0, 6.0])
def test_a_pointer_beside_a_cable_is_read(value: float, xs: tuple[int, int, int]) -> None:
    status = read_gauge(patch_of(hung(dark_face(value), xs, 85)), GAUGE)
    assert status.value is None or status.value == pytest.approx(value, abs=0.2)
    if xs[1] != 112:  # that cable is over the pivot, so a refusal is right
        assert status.answered


@pytest.mark.parametrize("knee", [(85, 125), (95, 95), (100, 150)])
@pytest.mark.parametrize("value", [1.0, 2.5, 4.0, 6.5, 8.0, 9.5])
def test_a_thick_bent_cable_is_no_pointer(value: float, knee: tuple[int, int]) -> None:
    picture = dark_face(value)
    cv2.polylines(picture, [np.array([[-5, 60], knee, [100, SIZE + 5]])], False, 85, 36, cv2.LINE_8)
    for face in (picture, 255 - picture):
        status = read_gauge(patch_of(np.asarray(face, np.uint8)), GAUGE)
        assert status.value is None or status.confidence < 0.8 or status.value == pytest.approx(value, abs=0.2)


def test_a_pointer_of_an_uncertain_direction_is_refused() -> None:
    fit = PointerFit(
        angle_rad=0.3, sigma_rad=0.09, strength=40.0, contrast=90.0, rival_ratio=0.1, rival_rad=2.0, supported=1.0,
        shown=1.0, is_dark=True, unknown=0.0,
    )  # fmt: skip
    assert status_of_pointer(replace(fit, sigma_rad=0.01), SCALE, 1.0).answered
    told = status_of_pointer(fit, SCALE, 1.0)
    assert not told.answered and "0.09 rad" in (told.reason or "")


def test_a_rival_where_nothing_else_should_stand_makes_a_pointer_unsure() -> None:
    """A meter has no numerals where its pointer is searched for, but a gauge has."""
    fit = PointerFit(
        angle_rad=0.1, sigma_rad=0.005, strength=50.0, contrast=30.0, rival_ratio=0.3, rival_rad=0.5, supported=1.0,
        shown=1.0, is_dark=True, unknown=0.1,
    )  # fmt: skip
    assert status_of_pointer(fit, SCALE, 1.0).confidence > 0.95
    assert status_of_pointer(fit, SCALE, 1.0, rival=RIVAL, sigma_rad=SIGMA_RAD).confidence < 0.8


def slider(cap_middle: int, hose: tuple[int, int] | None) -> NDArray[np.uint8]:
    """Draw a dark cap 54 px long on a slot, and a hose of the cap's width across it, given by its ends."""
    picture = np.full((SIZE, SIZE), 170, np.uint8)
    cv2.rectangle(picture, (20, MIDDLE - 3), (220, MIDDLE + 3), 25, -1)
    cv2.rectangle(picture, (cap_middle - 27, MIDDLE - 30), (cap_middle + 27, MIDDLE + 30), 35, -1)
    if hose is not None:
        cv2.line(picture, (hose[0], -5), (hose[1], SIZE + 5), 20, 52)
    return picture


def test_a_hose_as_wide_as_the_cap_is_no_cap() -> None:
    clear = read_slider(patch_of(slider(90, None)), SLIDER)
    assert clear.value == pytest.approx(100 * (90 - 60) / 120, abs=1.0)
    for hose in ((72, 76), (66, 70), (108, 112), (80, 84)):
        told = read_slider(patch_of(slider(90, hose)), SLIDER)
        assert told.value is None or told.value == pytest.approx(clear.value, abs=2.0)


@pytest.mark.parametrize("seed", [10035, 10280])
def test_a_label_that_leads_into_the_slot_does_not_hide_the_track(seed: int) -> None:
    """A faint word below a track leads into slot and cap if followed by its gray; a cable comes out at another side."""
    rows = [row for row in read_scene(draw_scene(seed, "hard")) if row.kind == "slider"]
    assert rows and all(row.is_right for row in rows)


@pytest.mark.parametrize("seed", [10142, 10177])
def test_cables_that_may_be_spokes_make_a_wheel_unsure(seed: int) -> None:
    rows = [row for row in read_scene(draw_scene(seed, "hard")) if row.kind == "handwheel"]
    assert rows and all(row.is_right or row.confidence < 0.8 for row in rows)


def test_a_cable_of_the_faces_own_gray_does_not_hide_the_face() -> None:
    """A search for the cable's gray would cover the whole face and its rim."""
    status = read_gauge(patch_of(hung(dark_face(6.0), (80, 84, 150), 34), noise=4.0), GAUGE)
    assert status.value == pytest.approx(6.0, abs=0.1)


def lever(angle_rad: float) -> NDArray[np.uint8]:
    picture = np.full((SIZE, SIZE), 170, np.uint8)
    cv2.line(picture, (MIDDLE, MIDDLE), towards(angle_rad, 0.029 * PX_PER_M - 12), 75, 24, cv2.LINE_AA)
    return picture


@pytest.mark.parametrize("xs", [(112, 120, 124), (126, 116, 110), (118, 118, 118)])
def test_a_cable_over_the_hub_is_no_handle(xs: tuple[int, int, int]) -> None:
    status = read_lever(patch_of(hung(lever(np.pi / 2), xs, 40)), LEVER)
    assert status.state in ("open", None)
    bare = read_lever(patch_of(hung(np.full((SIZE, SIZE), 170, np.uint8), xs, 40)), LEVER)
    assert not bare.answered, "a cable alone is no lever"


def test_a_handle_that_a_cable_crosses_is_read() -> None:
    patch = patch_of(hung(lever(np.pi / 2), (150, 160, 180), 40))
    assert read_lever(patch, LEVER).state == "open"


def lens(radius_px: int, gray: int, xs: tuple[int, int, int] | None) -> Patch:
    """Draw a lamp's lens with a dark bezel on the plate, and a cable of the bezel's gray in front of it."""
    picture = np.full((SIZE, SIZE), 150, np.uint8)
    cv2.circle(picture, (MIDDLE, MIDDLE), round(1.2 * radius_px), 40, -1, cv2.LINE_AA)
    cv2.circle(picture, (MIDDLE, MIDDLE), radius_px, gray, -1, cv2.LINE_AA)
    return patch_of(picture if xs is None else hung(picture, xs, 60))


@pytest.mark.parametrize(("gray", "state"), [(250, "on"), (60, "off")])
def test_a_lamp_behind_a_cable_is_read_by_what_shows_of_it_or_not_at_all(gray: int, state: str) -> None:
    lamp = Lamp(kind="lamp", name="alarm", position_m=(0.0, 0.0), radius_m=55 / PX_PER_M)
    assert read_lamp(lens(55, gray, None), lamp).state == state
    for xs in ((110, 120, 130), (100, 112, 118), (140, 150, 145), (60, 120, 180)):
        assert read_lamp(lens(55, gray, xs), lamp).state in (state, None)
    small = Lamp(kind="lamp", name="alarm", position_m=(0.0, 0.0), radius_m=14 / PX_PER_M)
    told = read_lamp(lens(14, gray, (120, 120, 120)), small)
    assert told.state is None and "across the lamp" in (told.reason or "")


def test_a_pipe_through_the_middle_is_the_objects_own() -> None:
    upright, across = hung(np.full((SIZE, SIZE), 170, np.uint8), (120, 120, 120), 110), np.array([0.0, np.pi / 2])
    assert cables_across(patch_of(upright), radius_m=0.036, own_rad=across) is None
    assert cables_across(patch_of(upright), radius_m=0.036, own_rad=across + np.pi / 4) is not None


def test_a_bar_is_told_by_its_known_stations() -> None:
    patch = patch_of(lever(0.0))
    hidden = np.zeros((SIZE, SIZE), bool)
    hidden[45:60] = True
    patch.gray[hidden] = 75  # the cable has the bar's gray
    bar = {"along_m": (0.012, 0.026), "half_width_m": 0.004}
    seen = bar_contrast(patch, 0.0, hidden=hidden, **bar)[0]
    assert seen == pytest.approx(-95.0, abs=5.0)
    assert abs(bar_contrast(patch, 0.0, **bar)[0]) < 0.5 * abs(seen)
    assert bar_contrast(patch, 0.0, hidden=np.ones_like(hidden), **bar)[0] == 0.0


def test_an_easy_drawn_panel_is_read_and_recognised() -> None:
    scene = draw_scene(1000, "easy")
    rows = read_scene(scene)
    assert len(rows) >= 11 and all(row.is_right for row in rows)
    found, given, there = found_blind(scene)
    assert found >= 0.75 * there and found <= given


@pytest.mark.parametrize("seed", [20044, 20064])
def test_a_number_that_leaves_strokes_over_is_refused(seed: int) -> None:
    """A misplaced grid may read 4.94 as 4.44, and a cable of the window's gray 7.11 as 7.14."""
    case = draw_taught(seed, "hard")
    status = read_case(case, known=False)
    assert status.text in (case.text, None)


def test_stray_ink_is_what_no_lit_segment_accounts_for() -> None:
    grid = DigitGrid(left_px=10.0, pitch_px=30.0, width_px=18.0, top_px=12.0, bottom_px=52.0, slant=0.0, count=2)
    lit = np.zeros((2, 7))
    lit[:, [1, 2]] = 100.0  # shows 11
    ink = np.zeros((64, 80), np.float32)
    for x in (28, 58):
        cv2.line(ink, (x, 14), (x, 50), 100.0, 4)
    assert stray_ink(ink, grid, lit) < 0.01
    assert stray_ink(ink + 15.0, grid, lit) < 0.02, "an even ground is no stroke"
    cv2.line(ink, (42, 12), (54, 12), 100.0, 4)  # makes the second digit a 7
    assert stray_ink(ink, grid, lit) > 0.1
    lit[1, 0] = 100.0
    assert stray_ink(ink, grid, lit) < 0.03


def test_a_sure_reading_proves_an_object_whose_outline_does_not_show() -> None:
    scene = draw_scene(100, "hard")
    (display,) = [
        panel_object
        for panel_object in scene.truth["objects"]
        if panel_object["cls"] == "display" and panel_object["text"] == "-348"
    ]
    (read,) = [row for row in read_scene(scene) if row.kind == "display" and row.truth == display["text"]]
    assert read.is_right
