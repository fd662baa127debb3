"""Toggle switches are read where their bat is, although the registered panel has it a few millimetres aside."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hal.panel import Toggle
from perception.vision.patch import Patch
from perception.vision.status.toggle import read_toggle

PX_PER_M = 2300.0
SIZE = 160
PLATE, BASE, NUT, BAT = 150.0, 20.0, 100.0, 220.0
TOGGLE = Toggle(name="pump", position_m=(0.0, 0.0))


def switch(aside_m: float, sign: float, seed: int) -> Patch:
    """Draw a switch whose bat leans up (`sign` 1) or down, seen from far away, `aside_m` to the right of its place."""
    middle = SIZE / 2 + np.array([aside_m * PX_PER_M, 0.0])
    picture = np.full((SIZE, SIZE), PLATE, np.float32)
    radius_px = TOGGLE.bat_radius_m * PX_PER_M
    corners = [tuple(np.round(middle + k * np.array([2.2, 3.4]) * radius_px).astype(int).tolist()) for k in (-1, 1)]
    cv2.rectangle(picture, corners[0], corners[1], BASE, -1)
    cv2.circle(picture, tuple(np.round(middle * 16).astype(int).tolist()), round(1.75 * radius_px * 16), NUT, -1, 16, 4)
    reach_px = TOGGLE.bat_length_m * np.sin(TOGGLE.tilt_rad) * PX_PER_M
    parts = [
        (share, 0.5, BAT) for share in np.linspace(-0.35, 0.6, 16)
    ]  # a stem, and a round end that looks at the camera
    for share, radii, gray_level in [*parts, (0.95, 1.0, BAT), (1.2, 0.85, NUT)]:
        place = middle - np.array([0.0, sign * share * reach_px])
        centre = tuple(np.round(place * 16).astype(int).tolist())
        cv2.circle(picture, centre, round(radii * radius_px * 16), gray_level, -1, 16, 4)
    noise = np.random.default_rng(seed).normal(0.0, 1.5, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.2) + noise), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([SIZE / 2, SIZE / 2]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("aside_m", [0.0, 0.0022, -0.0022])
@pytest.mark.parametrize(("sign", "state"), [(1.0, "on"), (-1.0, "off")])
def test_a_bat_is_read_also_where_the_registered_panel_has_it_aside(
    sign: float, state: str, aside_m: float, seed: int
) -> None:
    status = read_toggle(switch(aside_m, sign, seed), TOGGLE)
    assert status.state == state and status.answered
