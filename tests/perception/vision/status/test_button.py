"""Tests of buttons seen from the side, with a ring of the cap's gray around it, and from straight ahead."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hal.panel import LATCHED_SHARE, Button, Mushroom
from perception.vision.patch import Patch
from perception.vision.status import button
from perception.vision.status.button import read_button
from perception.vision.status.press import CapHeight, cap_height

SIZE, PX_PER_M = 160, 2500.0
SURE = 0.8
LEAN = 0.42  # tangent of the camera's viewing angle
BUTTON = Button(kind="button", name="hold", position_m=(0.0, 0.0), radius_m=0.013, latching=True)


def seen_aslant(height_m: float, *, cap: int, ring: int, ring_m: float = 0.0157, light: float = 1.0) -> Patch:
    """Draw a cap that protrudes by `height_m`, on a flat ring on a bright plate; `light` multiplies the gray levels."""
    middle = (SIZE - 1) / 2
    parallax = np.array([LEAN * PX_PER_M, 0.0])

    def disc(radius_m: float, z_m: float) -> np.ndarray:
        a = np.linspace(0, 2 * np.pi, 90)
        rim = np.column_stack([np.sin(a), np.cos(a)]) * radius_m * PX_PER_M * (1 + z_m / 0.3)
        return np.asarray(np.round((rim + middle + parallax * z_m) * 16), np.int32)

    picture = np.full((SIZE, SIZE), 170, np.uint8)
    foot, top = disc(BUTTON.radius_m, 0.0), disc(BUTTON.radius_m, height_m)
    for shape, gray in ((disc(ring_m, 0.0), ring), (cv2.convexHull(np.vstack([foot, top])), cap + 6), (top, cap)):
        cv2.fillConvexPoly(picture, shape, gray, cv2.LINE_AA, 4)
    rough = np.random.default_rng(0).normal(0.0, 1.5, picture.shape)
    blurred = light * cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.2)
    gray = np.clip(np.round(blurred + rough), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([middle, middle]), parallax_px_per_m=parallax, growth_per_m=1 / 0.3, plane_z_m=0.0,
    )  # fmt: skip


def test_a_bright_cap_on_a_dark_ring_is_read() -> None:
    latched = BUTTON.height_m - BUTTON.pressed_depth_m
    assert read_button(seen_aslant(BUTTON.height_m, cap=90, ring=20), BUTTON).state == "released"
    assert read_button(seen_aslant(latched, cap=90, ring=20), BUTTON).state in ("pressed", None)


@pytest.mark.parametrize("light", [2.0, 4.0, 8.0])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_glare_that_cuts_off_the_edges_of_a_cap_makes_its_height_uncertain(light: float, share: float) -> None:
    found = {}
    for level in (1.0, light):
        patch = seen_aslant(BUTTON.height_m - share * BUTTON.travel_m, cap=30, ring=150, light=level)
        low_m, high_m = BUTTON.height_m - BUTTON.travel_m, BUTTON.height_m
        found[level] = cap_height(patch, radius_m=BUTTON.radius_m, low_m=low_m, high_m=high_m, foot_m=0.0)
    plain, glared = found[1.0], found[light]
    assert plain is not None
    assert glared is None or abs(glared.height_m - plain.height_m) < 2.5 * glared.sigma_m


@pytest.mark.parametrize("depth", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("ring_m", [0.0152, 0.0157, 0.0162])
def test_the_ring_round_a_black_cap_is_not_taken_for_its_edge(depth: float, ring_m: float) -> None:
    """The edge of the ring is where that of a released cap would be."""
    patch = seen_aslant(BUTTON.height_m - depth * BUTTON.travel_m, cap=18, ring=20, ring_m=ring_m)
    assert read_button(patch, BUTTON).state in ("pressed", None)


@pytest.mark.parametrize(
    ("above", "sigma", "state"),
    [(0.5, 0.02, "released"), (-0.5, 0.02, "pressed"), (0.13, 0.2, None), (-0.13, 0.2, None), (0.5, 1.0, None)],
)
def test_a_height_between_both_states_or_measured_badly_is_not_answered(
    above: float, sigma: float, state: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pressed black cap in a black ring was measured 0.13 of its way above the middle, +- 0.2 of it, which is wrong."""
    cap, patch = BUTTON.cap, seen_aslant(BUTTON.height_m, cap=90, ring=20)
    assert cap is not None
    way_m = cap.pressed_depth_m
    measured = CapHeight(height_m=cap.height_m - way_m / 2 + above * way_m, sigma_m=sigma * way_m)
    monkeypatch.setattr(button, "cap_height", lambda *_, **__: measured)
    assert read_button(patch, BUTTON).state == state


def test_a_latched_cap_is_less_deep_than_one_that_is_held() -> None:
    held = BUTTON.model_copy(update={"latching": False})
    assert held.pressed_depth_m == held.travel_m
    assert BUTTON.pressed_depth_m == LATCHED_SHARE * BUTTON.travel_m
    stop = Mushroom(kind="mushroom", name="stop", position_m=(0.0, 0.0))
    assert stop.pressed_depth_m == LATCHED_SHARE * stop.travel_m


def seen_straight(*, is_released: bool, cable_at_m: float | None = None, glare_at_m: float | None = None) -> Patch:
    """Draw a dark cap in a black ring and a bright collar, without heights, with a cable or a glare to its right."""
    half = (SIZE - 1) / 2
    picture = np.full((SIZE, SIZE), 140.0, np.float32)

    def disc(x_m: float, y_m: float, radius_m: float, gray: float) -> None:
        u, v = (round(16 * (half + k * PX_PER_M)) for k in (x_m, y_m))
        cv2.circle(picture, (u, v), round(16 * radius_m * PX_PER_M), gray, -1, cv2.LINE_AA, 4)

    R = BUTTON.radius_m
    disc(0.0, 0.0, R, 165.0)
    disc(0.0, 0.0, 0.85 * R, 35.0)
    if is_released:
        disc(0.1 * R, 0.12 * R, 0.82 * R, 30.0)
        disc(0.0, 0.0, 0.77 * R, 70.0)
        disc(-0.2 * R, -0.22 * R, 0.26 * R, 130.0)
    else:
        disc(0.0, 0.0, 0.75 * R, 60.0)
    if glare_at_m is not None:
        v, u = np.mgrid[:SIZE, :SIZE]
        away = np.hypot(u - half - glare_at_m * PX_PER_M, v - half) / PX_PER_M
        picture = 255 * ((picture / 255) ** 2.2 + np.exp(-0.5 * (away / 0.012) ** 2)) ** (1 / 2.2)
    if cable_at_m is not None:
        u = half + cable_at_m * PX_PER_M
        ends = ((round(16 * (u - 12)), 0), (round(16 * (u + 12)), 16 * SIZE))
        cv2.line(picture, *ends, 50.0, round(0.004 * PX_PER_M), cv2.LINE_AA, 4)
    rough = np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.5) + rough), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([half, half]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


def test_a_cap_seen_straight_on_shows_its_shadow_and_its_shine() -> None:
    assert read_button(seen_straight(is_released=True), BUTTON).state == "released"
    assert read_button(seen_straight(is_released=False), BUTTON).state == "pressed"


@pytest.mark.parametrize("cable_at_m", [-0.014, -0.0115, 0.0115, 0.014])
@pytest.mark.parametrize("is_released", [False, True])
def test_a_cable_beside_a_cap_is_not_its_shadow(is_released: bool, cable_at_m: float) -> None:
    truth = "released" if is_released else "pressed"
    assert read_button(seen_straight(is_released=is_released, cable_at_m=cable_at_m), BUTTON).state in (truth, None)


@pytest.mark.parametrize("glare_at_m", [-0.025, 0.02, 0.025])
def test_a_glare_beside_a_flush_cap_is_not_its_shine(glare_at_m: float) -> None:
    assert read_button(seen_straight(is_released=False, glare_at_m=glare_at_m), BUTTON).state in ("pressed", None)


def test_a_cap_too_bright_to_shine_is_not_surely_pressed() -> None:
    """Cap and plate are nearly white, so highlights are invisible and the shadow is faint."""
    clear = seen_straight(is_released=True)
    bright = np.clip(np.round(225 + 0.08 * (clear.gray.astype(float) - 60)), 0, 255).astype(np.uint8)
    status = read_button(replace(clear, gray=bright), BUTTON)
    assert status.state in ("released", None) or status.confidence < 0.8


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_a_black_cap_is_not_its_shine(seed: int) -> None:
    """In a dark image the noise of a camera is largest in the darkest parts."""
    clear = seen_straight(is_released=False)
    linear = (0.45 * clear.gray.astype(float) / 255) ** 2.2
    rough = cv2.resize(np.random.default_rng(seed).normal(0.0, 1.0, (SIZE * 2 // 3,) * 2), (SIZE, SIZE))
    gray = np.round(255 * np.clip(linear + 0.006 * rough, 0.0, 1.0) ** (1 / 2.2)).astype(np.uint8)
    status = read_button(replace(clear, gray=gray), BUTTON)
    assert status.state == "pressed" or status.confidence < 0.8


def seen_from_ahead(below_px: float) -> Patch:
    """Draw a bright cap without highlight in a dark gap that is `below_px` thicker below, as seen by a homography."""
    middle = (SIZE - 1) / 2
    picture = np.full((SIZE, SIZE), 130, np.uint8)
    R = BUTTON.radius_m * PX_PER_M
    for share, down_px, gray in ((0.92, 0.0, 165), (0.78, below_px / 2, 35), (0.68, 0.0, 215)):
        centre = (round(16 * middle), round(16 * (middle + down_px)))
        cv2.circle(picture, centre, round(16 * share * R), gray, -1, cv2.LINE_AA, 4)
    rough = np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.2) + rough), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([middle, middle]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


def test_a_cap_whose_gap_is_dark_below_is_not_called_pressed() -> None:
    """The side of the cap is visible below it, so the missing highlight must not make it pressed."""
    assert read_button(seen_from_ahead(4.0), BUTTON).state in ("released", None)
    for below_px in (0.0, -4.0):
        assert read_button(seen_from_ahead(below_px), BUTTON).state == "pressed"


@pytest.mark.parametrize("seed", [3, 6, 8, 14, 31, 35])
def test_noise_on_a_black_cap_is_not_its_shine(seed: int) -> None:
    """The camera cuts the noise of a black face off at zero, so that what is left of it looks like bright spots."""
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    picture = np.where(np.hypot(u, v) < BUTTON.radius_m * PX_PER_M, 6.0, 90.0)
    noise = np.random.default_rng(seed).normal(0.0, 14.0, picture.shape)
    seen = cv2.GaussianBlur(picture, (0, 0), 1.5) + cv2.GaussianBlur(noise, (0, 0), 0.7)
    patch = replace(seen_straight(is_released=False), gray=np.clip(np.round(seen), 0, 255).astype(np.uint8))
    assert read_button(patch, BUTTON).state != "released"


@pytest.mark.parametrize(("at_m", "size_m"), [(0.010, 0.006), (0.012, 0.009), (0.014, 0.006)])
def test_glare_that_saturates_beside_a_cap_is_not_its_shine(at_m: float, size_m: float) -> None:
    plain = seen_straight(is_released=False)
    v, u = (np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2) / PX_PER_M
    glare = 2.0 * np.exp(-0.5 * (np.hypot(u - at_m, v - at_m) / size_m) ** 2)
    seen = 255 * ((plain.gray / 255.0) ** 2.2 + glare) ** (1 / 2.2)
    found = read_button(replace(plain, gray=np.clip(np.round(seen), 0, 255).astype(np.uint8)), BUTTON)
    assert found.state != "released" or found.confidence < SURE
