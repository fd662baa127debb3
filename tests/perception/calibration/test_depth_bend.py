"""The bend of a range camera: walls tell it at any distance, what stands before them does not, and what is none is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hal.arrays import Array
from hal.calibration import CalibrationRecord, DepthBendRecord, load_calibration
from hal.errors import InvalidRequest, NotObservable
from perception.calibration import calibrate_depth
from perception.range import PinholeSensor, analyse
from service.cli import _app

SENSOR = PinholeSensor(width_px=160, height_px=120, fx_px=150.0, fy_px=150.0, cx_px=79.5, cy_px=59.5)
FOCAL, CENTRE = (SENSOR.fx_px, SENSOR.fy_px), (SENSOR.cx_px, SENSOR.cy_px)
V, U = np.mgrid[: SENSOR.height_px, : SENSOR.width_px]
X, Y = (U - CENTRE[0]) / FOCAL[0], (V - CENTRE[1]) / FOCAL[1]
BEND = 0.02 * (X**2 + 0.5 * Y**2 - X * Y)  # 1/m: 4 mm in the corners at 1 m
NOISE = 0.0008  # 1/m, of a pixel
WALLS = ((0.8, 0.0, 0.1), (1.3, 0.2, -0.1), (1.9, -0.15, 0.05))


def wall(distance_m: float, a: float, b: float, *, bend: Array = BEND, seed: int = 0) -> Array:
    """Return the depth of a wall, which a bent camera measures with noise."""
    inverse = (1.0 + a * X + b * Y) / distance_m - bend
    return np.asarray(1.0 / (inverse + np.random.default_rng(seed).normal(0.0, NOISE, inverse.shape)))


def off_plane(inverse: Array) -> Array:
    """Return what a plane leaves of a field of inverse depth."""
    A = np.column_stack([X.ravel(), Y.ravel(), np.ones(X.size)])
    return np.asarray(inverse - (A @ np.linalg.lstsq(A, inverse.ravel(), rcond=None)[0]).reshape(inverse.shape))


def test_walls_at_several_distances_tell_the_bend_without_its_linear_part() -> None:
    found = calibrate_depth([wall(*one, seed=k) for k, one in enumerate(WALLS)], FOCAL, CENTRE)
    assert found.walls == 3 and found.before > 10 * found.after
    flat = 1.0 / found.record.straightened(1.0 / np.full(X.shape, 1.0))
    assert np.abs(off_plane(flat) - off_plane(BEND)).max() < 0.15 * np.ptp(off_plane(BEND))
    fresh = found.record.straightened(wall(1.1, 0.1, 0.2, seed=9))
    left = off_plane(1.0 / fresh)
    assert np.std(left) < 1.1 * NOISE < 0.5 * np.std(off_plane(1.0 / wall(1.1, 0.1, 0.2, seed=9)))


def test_a_box_before_the_wall_and_pixels_without_reading_do_not_change_it() -> None:
    plain = [wall(*one, seed=k) for k, one in enumerate(WALLS)]
    crowded = [image.copy() for image in plain]
    crowded[1][40:80, 60:110] -= 0.3
    crowded[2][:, :12] = np.nan
    one, two = (np.array(calibrate_depth(images, FOCAL, CENTRE).record.per_m) for images in (plain, crowded))
    assert np.abs(one - two).max() < 0.15 * np.ptp(one)


def test_a_straight_camera_has_no_bend() -> None:
    straight = [wall(*one, bend=np.zeros(X.shape), seed=k) for k, one in enumerate(WALLS)]
    found = calibrate_depth(straight, FOCAL, CENTRE)
    assert np.abs(np.array(found.record.per_m)).max() < 0.3 * np.ptp(off_plane(BEND))


def test_what_is_no_bend_of_inverse_depth_is_refused() -> None:
    changing = [
        wall(*one, bend=sign * BEND, seed=k) for k, (one, sign) in enumerate(zip(WALLS, (1, -1, 1), strict=True))
    ]
    with pytest.raises(NotObservable, match="not the same in all 3"):
        calibrate_depth(changing, FOCAL, CENTRE)
    half = wall(*WALLS[0])
    half[:, :80] = np.nan
    with pytest.raises(NotObservable, match="image 1 measures only"):
        calibrate_depth([half], FOCAL, CENTRE)
    with pytest.raises(InvalidRequest, match="sizes"):
        calibrate_depth([half, half[:50]], FOCAL, CENTRE)
    with pytest.raises(InvalidRequest, match="no depth images"):
        calibrate_depth([], FOCAL, CENTRE)


def test_a_record_straightens_only_images_of_its_size() -> None:
    record = DepthBendRecord(width_px=160, height_px=120, per_m=((0.0, 0.1), (0.0, 0.1)))
    straight = record.straightened(np.full((120, 160), 2.0))
    assert straight[0, 0] == pytest.approx(2.0) and straight[5, -1] == pytest.approx(1.0 / 0.6)
    with pytest.raises(InvalidRequest, match="160x120"):
        record.straightened(np.ones((60, 80)))


def test_the_command_writes_a_record_that_the_range_command_uses(tmp_path: Path) -> None:
    for k, one in enumerate(WALLS):
        save(tmp_path / f"wall-{k}.npz", wall(*one, seed=k))
    out = tmp_path / "camera.toml"
    out.write_text(
        'schema = 1\ndevice = "range_scanner"\ndate = "2026-01-01"\nmethod = "ruler"\n'
        "[mount]\nposition_m = [0.0, 0.0, 0.1]\nrpy_rad = [0.0, 0.0, 0.0]\n"
    )  # fmt: skip
    words = ["calibrate", "depth", *(str(tmp_path / f"wall-{k}.npz") for k in range(3)), "--out", str(out)]
    told = CliRunner().invoke(_app(), words)
    assert told.exit_code == 0 and "3 walls" in told.output, told.output
    record: CalibrationRecord = load_calibration(out)
    assert record.depth_bend is not None and record.version == 2 and record.mount is not None
    save(tmp_path / "seen.npz", wall(1.1, 0.1, 0.2, seed=9))
    words = ["range", str(tmp_path / "seen.npz"), "--record", str(out), "--out", str(tmp_path)]
    told = CliRunner().invoke(_app(), words)
    assert told.exit_code == 0 and "plane" in told.output, told.output
    assert analyse(record.depth_bend.straightened(wall(1.1, 0.1, 0.2, seed=9)).astype(float), SENSOR).surfaces


def save(path: Path, depth_m: Array) -> None:
    np.savez(path, depth=1e3 * depth_m, K=np.array([*FOCAL, *CENTRE]))
