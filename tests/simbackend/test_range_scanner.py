"""Tests of the range scanner: the depth is exact, and each corruption has its effect."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from simbackend.arm_model import base_from_flange, t3
from simbackend.client import true_mount
from simbackend.draws import Draws
from simbackend.range_sensor import MAX_RANGE_M, MIN_RANGE_M, RangeOptions, corrupt
from tests.simbackend.rig import SimCell

CLEAN = {"sigma_m": 0.0, "mixed_ratio": 0.0, "loss_ratio": 0.0, "bits": 24}


def depth(level_m: float = 0.5) -> NDArray[np.float32]:
    return np.full((64, 64), level_m, np.float32)


def random() -> np.random.Generator:
    return np.random.default_rng(4)


@pytest.mark.parametrize("size", [128, 256])
def test_a_clean_scan_lies_on_the_true_plate(bench: SimCell, size: int) -> None:
    scanner = bench.connect("range_scanner", width=size, height=size, **CLEAN)
    image = scanner.read_range(deadline=bench.deadline()).value.depth_m
    c = scanner.capabilities()
    v, u = np.mgrid[0:size, 0:size]
    points = np.stack([(u - c.cx) / c.fx * image, (v - c.cy) / c.fy * image, image], axis=-1)[np.isfinite(image)]
    draws = Draws(bench.cell.file.cell.seed)
    arm = bench.connect("arm")
    q = arm.read_state(deadline=bench.deadline()).value.position_rad
    base_from_scanner = base_from_flange(t3().capabilities.links, q) * true_mount(bench.cell, draws, "range_scanner")
    base_from_panel = RigidTransform.from_matrix(arm.truth().base_from_panel_matrix)
    on_panel = (base_from_panel.inv() * base_from_scanner).apply(points)
    inside = (np.abs(on_panel[:, 0]) < 0.30) & (np.abs(on_panel[:, 1]) < 0.22)
    heights = on_panel[inside, 2]
    assert len(heights) > 0.2 * size * size
    # Most points are on the bare plate, to 0.01 mm; the others are in front of it, and none is behind it.
    assert np.mean(np.abs(heights) < 1e-5) > 0.6
    assert heights.min() > -1e-5
    assert 0.01 < heights.max() < 0.04


def test_noise_grows_with_the_square_of_the_distance() -> None:
    options = RangeOptions(**{**CLEAN, "sigma_m": 0.001})
    assert corrupt(depth(0.5), options, random()).std() == pytest.approx(0.001, rel=0.05)
    assert corrupt(depth(1.0), options, random()).std() == pytest.approx(0.004, rel=0.05)


def test_eight_bits_give_the_papers_256_steps() -> None:
    options = RangeOptions(**{**CLEAN, "bits": 8, "sigma_m": 0.002})
    levels = np.unique(corrupt(depth(0.7), options, random()))
    step_m = (MAX_RANGE_M - MIN_RANGE_M) / 255
    np.testing.assert_allclose(np.diff(levels) / step_m, np.round(np.diff(levels) / step_m), atol=1e-3)
    assert 2 <= len(levels) <= 6


def test_mixed_pixels_appear_at_jumps_only_and_between_the_two_surfaces() -> None:
    options = RangeOptions(**{**CLEAN, "mixed_ratio": 1.0})
    jump = depth(0.5)
    jump[:, 32:] = 0.8
    out = corrupt(jump, options, random())
    np.testing.assert_allclose(out[:, :31], 0.5, atol=1e-6)
    np.testing.assert_allclose(out[:, 34:], 0.8, atol=1e-6)
    mixed = out[:, 31:33]
    assert np.all((mixed >= 0.5 - 1e-6) & (mixed <= 0.8 + 1e-6))
    assert np.mean((mixed > 0.51) & (mixed < 0.79)) > 0.8


def test_lost_and_distant_pixels_are_nan() -> None:
    assert np.isnan(corrupt(depth(MAX_RANGE_M + 0.1), RangeOptions(**CLEAN), random())).all()
    assert np.isnan(corrupt(depth(np.nan), RangeOptions(**CLEAN), random())).all()
    lost = np.isnan(corrupt(depth(), RangeOptions(**{**CLEAN, "loss_ratio": 0.1}), random())).mean()
    assert lost == pytest.approx(0.1, abs=0.02)


def test_a_line_scanner_keeps_its_scans_while_it_records_and_each_is_of_its_own_time(bench: SimCell) -> None:
    scanner = bench.connect("range_scanner", model="polar", width=33, line_rate_hz=25.0, **CLEAN)
    line = scanner.read_range(deadline=bench.deadline()).value.depth_m
    assert line.shape == (1, 33) and np.isfinite(line).any()
    scanner.start_recording(deadline=bench.deadline())
    bench.clock.sleep(0.3)
    scans = scanner.end_recording(deadline=bench.deadline())
    assert 6 <= len(scans) <= 8
    np.testing.assert_allclose(np.diff([scan.host_time_s for scan in scans]), 0.04, atol=0.0021)
    for scan in scans:  # the arm rests, so all scans are equal
        np.testing.assert_allclose(scan.value.depth_m, line, atol=2e-5)
    scanner.start_recording(deadline=bench.deadline())  # at once, while a scan of the recording before is planned
    bench.clock.sleep(0.3)
    again = scanner.end_recording(deadline=bench.deadline())
    assert 6 <= len(again) <= 8
    for scan in again:
        np.testing.assert_allclose(scan.value.depth_m, line, atol=2e-5)
    bench.clock.sleep(0.2)
    assert scanner.end_recording(deadline=bench.deadline()) == ()


def test_a_line_of_beams_lies_in_the_middle_row_of_a_range_image(bench: SimCell) -> None:
    camera = bench.connect("range_scanner", width=257, height=257, field_of_view_rad=0.9, **CLEAN)
    row = camera.read_range(deadline=bench.deadline()).value.depth_m[128]
    c = camera.capabilities()
    polar = bench.connect("range_scanner", model="polar", width=65, field_of_view_rad=0.9, **CLEAN)
    line, p = polar.read_range(deadline=bench.deadline()).value.depth_m[0], polar.capabilities()
    angle = p.first_angle_rad + np.arange(65) * p.step_angle_rad
    along_the_row = np.interp(c.fx * np.tan(angle) + c.cx, np.arange(257), row) / np.cos(angle)
    assert p.needs_sweep and not c.needs_sweep
    assert np.nanmedian(np.abs(line - along_the_row)) < 1e-4
