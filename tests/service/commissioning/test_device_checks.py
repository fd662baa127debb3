"""Checks of single devices: they measure what was drawn, judge it in words, and draw a picture, over wires too."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hal.config import load_cell
from hal.errors import InvalidRequest
from service.commissioning.device_checks import camera_findings, check_device, lag_of
from service.commissioning.image_quality import quality_of
from service.terminal import ROOT

PNG = b"\x89PNG"


def drawn(blur_px: float, *, across_px: int = 0, gain: float = 1.0, count: int = 3) -> list[NDArray[np.uint8]]:
    """Return noisy frames of squares with a known blur, drawn finer and then reduced."""
    image = np.full((960, 1280), 90.0, np.float32)
    rng = np.random.default_rng(5)
    for _ in range(60):
        x, y = (int(v) for v in rng.integers(20, 900, 2))
        cv2.rectangle(image, (x, y), (x + 90, y + 70), float(rng.uniform(20, 210)), -1)
    image = cv2.GaussianBlur(image, (0, 0), 2 * blur_px)
    if across_px:
        image = cv2.blur(image, (2 * across_px, 1))
    image = gain * cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
    return [np.clip(image + rng.normal(scale=1.0, size=image.shape), 0, 255).astype(np.uint8) for _ in range(count)]


def wrong(frames: list[NDArray[np.uint8]]) -> list[str]:
    return [finding.what.split(":")[0] for finding in camera_findings(quality_of(frames)) if not finding.is_good]


@pytest.mark.parametrize("blur_px", [0.7, 1.2, 2.5])
def test_the_blur_of_edges_is_measured(blur_px: float) -> None:
    assert quality_of(drawn(blur_px)).blur_px == pytest.approx(np.hypot(blur_px, 0.29), rel=0.2)


def test_each_fault_of_an_image_is_named_and_a_good_image_has_none() -> None:
    assert wrong(drawn(0.8)) == []
    assert wrong(drawn(3.0)) == ["focus"]
    assert "motion" in wrong(drawn(0.8, across_px=9))
    assert wrong(drawn(0.8, gain=0.2)) == ["exposure"]
    assert "exposure" in wrong(drawn(0.8, gain=1.8))
    assert wrong([drawn(0.8)[0]] * 3) == ["all frames are equal to the last bit"]
    assert wrong([np.full((480, 640), 120 + k, np.uint8) for k in range(3)]) == ["no edges in the image"]


def test_the_lag_of_an_arm_is_the_delay_that_fits_best() -> None:
    times_s = np.arange(0.0, 4.0, 0.004)
    sent = np.sin(2 * times_s)
    lag_s, rest = lag_of(times_s, sent, np.interp(times_s - 0.05, times_s, sent) + 0.001)
    assert lag_s == pytest.approx(0.05, abs=0.004) and rest == pytest.approx(0.001, rel=0.3)


def test_an_arm_moves_only_when_the_motion_is_confirmed() -> None:
    asked: list[str] = []
    with pytest.raises(InvalidRequest, match="was not confirmed, so nothing moved"):
        check_device(load_cell(ROOT / "cells/bench.toml"), "arm", may_move=lambda words: bool(asked.append(words)))
    assert "2 degrees" in asked[0]


def test_a_device_without_a_picture_is_referred_to_its_test() -> None:
    with pytest.raises(InvalidRequest, match="no check with a picture") as refused:
        check_device(load_cell(ROOT / "cells/bench.toml"), "gripper", may_move=lambda _: True)
    assert "conform" in refused.value.hint


@pytest.mark.slow
def test_the_simulated_sensor_lights_over_modbus_and_arm_are_judged() -> None:
    cell = load_cell(ROOT / "cells/mixed.toml")  # its lights are behind an emulated Modbus TCP wire
    wrench = check_device(cell, "wrist_ft", may_move=lambda _: True)
    assert wrench.is_good and wrench.png.startswith(PNG)
    assert any(finding.what.startswith("payload: the force differs by") for finding in wrench.findings)
    lights = check_device(cell, "panel_lights", may_move=lambda _: True)
    of_channel = {finding.what.split(":")[0]: finding.is_good for finding in lights.findings}
    # From where the arm is parked the camera sees three of the four lights.
    assert of_channel == {
        "light_upper_left": True, "light_upper_right": True, "light_lower_right": True, "light_lower_left": False
    }  # fmt: skip
    assert lights.png.startswith(PNG)
