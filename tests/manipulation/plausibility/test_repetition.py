"""Tests of sensors that repeat their reading, and of those that may do so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.devices import ForceTorqueCapabilities
from hal.errors import StaleReading
from manipulation.plausibility import FrameDigest, Symptom, repeated_frame
from manipulation.plausibility.repetition import RepeatedWrench
from tests.manipulation.rig import FakeForceTorque, World


def wrench(force_n: float) -> np.ndarray:
    return np.array([force_n, 0.0, 0.0, 0.0, 0.0, 0.0])


class Wrist(FakeForceTorque):
    """Force/torque sensor with a given noise and rate."""

    def __init__(self, *, force_sigma_n: float = 0.3, rate_hz: float = 500.0) -> None:
        super().__init__("wrist_ft", World())
        self.stated = replace(super().capabilities(), force_sigma_n=force_sigma_n, rate_hz=rate_hz)

    def capabilities(self) -> ForceTorqueCapabilities:
        return self.stated


def repeats_for_s(sensor: Wrist | None, *, every_s: float = 0.002, lasting_s: float = 2.0) -> float | None:
    """Return how long one reading may be repeated before it counts as a failure; None if without limit."""
    watch = RepeatedWrench(sensor)
    for tick in range(round(lasting_s / every_s)):
        finding = watch.note(wrench(1.0), stamp_s=tick * every_s)
        if finding is not None:
            assert (finding.device, finding.symptom) == ("wrist_ft", Symptom.FROZEN)
            assert "same reading under new stamps" in finding.what
            return tick * every_s
    return None


def test_a_wrench_that_repeats_under_new_stamps_is_a_failure_before_a_touch_grows_strong() -> None:
    assert repeats_for_s(Wrist()) == pytest.approx(0.1, abs=0.003)


def test_a_slow_sensor_repeats_itself_between_its_samples_and_few_ticks_prove_nothing() -> None:
    assert repeats_for_s(Wrist(rate_hz=10.0)) == pytest.approx(0.4, abs=0.003)
    assert repeats_for_s(Wrist(), every_s=0.05) == pytest.approx(0.5, abs=0.051)


def test_a_sensor_without_noise_may_repeat_itself_and_so_may_none() -> None:
    assert repeats_for_s(Wrist(force_sigma_n=0.0)) is None
    assert repeats_for_s(None) is None


def test_any_other_reading_begins_anew() -> None:
    watch = RepeatedWrench(Wrist())
    for tick in range(500):
        assert watch.note(wrench(float(tick // 45)), stamp_s=0.002 * tick) is None


PICTURE = np.arange(12.0).reshape(3, 4)


def test_a_frame_that_comes_again_under_a_new_stamp_names_its_camera() -> None:
    finding = repeated_frame("eye", FrameDigest.of(PICTURE, stamp_s=1.0), FrameDigest.of(PICTURE.copy(), stamp_s=1.1))
    assert finding is not None and finding.device == "eye"
    error = finding.error()
    assert isinstance(error, StaleReading) and error.details["cause"] == "frozen" and "power-cycle" in error.hint


@pytest.mark.parametrize(
    ("before", "stamp_s"),
    [(None, 1.1), (PICTURE, 1.0), (PICTURE + 1e-9, 1.1), (PICTURE[:, ::-1], 1.1)],
    ids=["first", "asked for twice", "noise", "mirrored"],
)
def test_a_first_frame_the_same_one_and_another_are_no_repetition(before: np.ndarray | None, stamp_s: float) -> None:
    earlier = None if before is None else FrameDigest.of(before, stamp_s=1.0)
    assert repeated_frame("eye", earlier, FrameDigest.of(PICTURE, stamp_s=stamp_s)) is None


def test_a_saturated_picture_that_comes_again_is_no_frozen_one() -> None:
    white = np.full_like(PICTURE, 255)
    assert repeated_frame("eye", FrameDigest.of(white, stamp_s=1.0), FrameDigest.of(white, stamp_s=1.1)) is None
