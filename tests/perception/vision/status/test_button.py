"""A cap's height from the side, with a ring of its own gray round it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hal.panel import LATCHED_SHARE, Button, Mushroom
from perception.vision.patch import Patch
from perception.vision.status.button import read_button

SIZE, PX_PER_M = 160, 2500.0
LEAN = 0.42  # tangent of the angle that the camera looks from
BUTTON = Button(kind="button", name="hold", position_m=(0.0, 0.0), radius_m=0.013, latching=True)


def seen_aslant(height_m: float, *, cap: int, ring: int, ring_m: float = 0.0157) -> Patch:
    """A cap that stands `height_m` out, on a flat ring on a bright plate."""
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
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.2) + rough), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([middle, middle]), parallax_px_per_m=parallax, growth_per_m=1 / 0.3, plane_z_m=0.0,
    )  # fmt: skip


def test_a_bright_cap_on_a_dark_ring_is_read() -> None:
    latched = BUTTON.height_m - BUTTON.pressed_depth_m
    assert read_button(seen_aslant(BUTTON.height_m, cap=90, ring=20), BUTTON).state == "released"
    assert read_button(seen_aslant(latched, cap=90, ring=20), BUTTON).state in ("pressed", None)


@pytest.mark.parametrize("depth", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("ring_m", [0.0152, 0.0157, 0.0162])
def test_the_ring_round_a_black_cap_is_not_taken_for_its_edge(depth: float, ring_m: float) -> None:
    """The ring's edge lies where that of a released cap would be."""
    patch = seen_aslant(BUTTON.height_m - depth * BUTTON.travel_m, cap=18, ring=20, ring_m=ring_m)
    assert read_button(patch, BUTTON).state in ("pressed", None)


def test_a_latched_cap_is_less_deep_than_one_that_is_held() -> None:
    held = BUTTON.model_copy(update={"latching": False})
    assert held.pressed_depth_m == held.travel_m
    assert BUTTON.pressed_depth_m == LATCHED_SHARE * BUTTON.travel_m
    stop = Mushroom(kind="mushroom", name="stop", position_m=(0.0, 0.0))
    assert stop.pressed_depth_m == LATCHED_SHARE * stop.travel_m
