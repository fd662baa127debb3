"""Levers whose handle is visible by its shadow only are read, and levers between their states are refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hal.panel import Lever, State
from perception.vision.patch import Patch
from perception.vision.status.lever import read_lever

PX_PER_M = 3000.0
SIZE = 320
LENGTH_M, WIDTH_M = 0.032, 0.0082
LEVER = Lever(
    kind="lever",
    name="inlet",
    position_m=(0.0, 0.0),
    length_m=LENGTH_M,
    width_m=WIDTH_M,
    states=(State(name="closed", angle_rad=0.0), State(name="open", angle_rad=float(np.pi / 2))),
)


def patch_of(picture: NDArray[np.float32], seed: int) -> Patch:
    noise = np.random.default_rng(seed).normal(0.0, 1.5, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.2) + noise), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=np.array([SIZE / 2, SIZE / 2]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


def drawn(angle_rad: float, handle: float, shadow: float | None) -> NDArray[np.float32]:
    """Draw a plate of gray 200 with a handle, and a shadow along its right side."""
    picture = np.full((SIZE, SIZE), 200.0, np.float32)
    along = np.array([np.sin(angle_rad), -np.cos(angle_rad)])
    across = np.array([-along[1], along[0]])
    middle, half, reach = np.full(2, SIZE / 2), WIDTH_M / 2 * PX_PER_M, LENGTH_M * PX_PER_M
    for gray, low, high in ((shadow, -1.0, 1.5), (handle, -1.0, 1.0)):
        if gray is None:
            continue
        corners = [middle + low * half * across, middle + high * half * across]
        corners += [c + reach * along for c in reversed(corners)]
        cv2.fillPoly(picture, [np.round(np.array(corners) * 16).astype(np.int32)], gray, cv2.LINE_AA, shift=4)
    return picture


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("angle_rad", "state"), [(0.0, "closed"), (np.pi / 2, "open")])
def test_a_handle_of_the_plates_gray_is_read_by_its_shadow(angle_rad: float, state: str, seed: int) -> None:
    status = read_lever(patch_of(drawn(angle_rad, 200.0, 60.0), seed), LEVER)
    assert status.state == state and status.value == pytest.approx(angle_rad, abs=0.17)


@pytest.mark.parametrize("off_rad", [0.2, 0.3, 0.45])
def test_a_handle_between_its_states_is_refused(off_rad: float) -> None:
    for seed, shadow in enumerate((None, 60.0)):
        status = read_lever(patch_of(drawn(off_rad, 90.0, shadow), seed), LEVER)
        assert not status.answered


@pytest.mark.parametrize(("handle", "state"), [(84.0, "open"), (100.0, None)])
def test_a_handle_beside_a_glare_is_read_and_the_glare_alone_is_none(handle: float, state: str | None) -> None:
    """The plate is far brighter than the handle on the side of the glare, and hardly brighter on the other side."""
    picture = drawn(float(np.pi / 2), 2 * handle, None) / 2
    v, u = np.mgrid[:SIZE, :SIZE]
    picture += 120.0 * np.exp(-((u - 220.0) ** 2 + (v - 90.0) ** 2) / (2 * 45.0**2))
    for seed in range(3):
        status = read_lever(patch_of(np.asarray(picture, np.float32), seed), LEVER)
        assert status.state == state
        assert state is None or status.confidence < 0.8
