"""Tests of `panelwright range` and `panelwright batch range`: a scene with known truth, real files, bad input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from hal.errors import InvalidRequest, NotFound
from perception.range.batch_results import BatchResult, KeptResults
from perception.range.recordings import Reading
from service.cli import _app
from tests.perception.range.scenes import ball_on_table, noisy
from tests.service.waiting import eventually

REAL = Path(__file__).parents[3].parent / "shared" / "data" / "range" / "real"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="the range development data is not beside the repository")
DEPTH_M = noisy(ball_on_table().depth_m, 0.0005, seed=1)
FOCAL = ("--focal", "180")


def run(*words: object) -> Result:
    return CliRunner().invoke(_app(), [str(word) for word in words])


@pytest.fixture
def metres(tmp_path: Path) -> Path:
    np.save(tmp_path / "scan.npy", DEPTH_M)
    return tmp_path / "scan.npy"


def test_one_image_gives_the_golden_document_a_picture_and_points(tmp_path: Path, metres: Path) -> None:
    result = run("range", metres, "--out", tmp_path / "out", *FOCAL)
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "out" / "scan.surfaces.json").read_text())
    assert set(document) == {
        "recording", "assumed", "frame", "noise_m_at_1_m", "warnings", "surfaces", "components",
    }  # fmt: skip
    assert (document["recording"], document["frame"], document["assumed"]) == ("scan.npy", "range_sensor", [])
    by_type = {surface["type"]: surface for surface in document["surfaces"]}
    assert set(by_type) == {"plane", "sphere", "cylinder"} and len(document["surfaces"]) == 3
    assert set(by_type["sphere"]) == {
        "label", "type", "pixels", "rms_m", "misfit", "middle_m", "parameters", "covariance_over", "covariance",
    }  # fmt: skip
    np.testing.assert_allclose(by_type["sphere"]["parameters"]["centre_m"], [-0.07, 0.0, 0.58], atol=5e-4)
    assert by_type["sphere"]["parameters"]["radius_m"] == pytest.approx(0.04, abs=5e-4)
    assert by_type["cylinder"]["parameters"]["radius_m"] == pytest.approx(0.025, abs=5e-4)
    normal = np.array([0.0, -0.5, -0.85]) / np.linalg.norm([0.5, 0.85])
    np.testing.assert_allclose(by_type["plane"]["parameters"]["normal"], normal, atol=2e-3)
    picture = cv2.imread(str(tmp_path / "out" / "scan.surfaces.png"))
    assert picture.shape == (480, 640, 3) and len(np.unique(picture.reshape(-1, 3), axis=0)) > 3
    points = (tmp_path / "out" / "scan.surfaces.ply").read_bytes()
    assert f"element vertex {DEPTH_M.size}\n".encode() in points
    lines = [line.split() for line in result.output.splitlines()]
    first = next(i for i, line in enumerate(lines) if "type" in line) + 1  # a slow machine is asked for patience before
    assert [line[1] for line in lines[first : first + 3]] == ["plane", "cylinder", "sphere"]


def _millimetres(path: Path) -> tuple[object, ...]:
    cv2.imwrite(str(path.with_suffix(".png")), np.rint(1e3 * DEPTH_M).astype(np.uint16))
    return (path.with_suffix(".png"),)


def _fifths_of_a_millimetre(path: Path) -> tuple[object, ...]:
    cv2.imwrite(str(path.with_suffix(".png")), np.rint(5e3 * DEPTH_M).astype(np.uint16))
    return path.with_suffix(".png"), "--scale", "0.0002"


def _eight_bit(path: Path) -> tuple[object, ...]:
    near, far = float(DEPTH_M.min()), float(DEPTH_M.max())
    cv2.imwrite(str(path.with_suffix(".png")), np.rint(255 * (DEPTH_M - near) / (far - near)).astype(np.uint8))
    return path.with_suffix(".png"), "--near", near, "--far", far


def _float_picture(path: Path) -> tuple[object, ...]:
    cv2.imwrite(str(path.with_suffix(".tiff")), DEPTH_M.astype(np.float32))
    return (path.with_suffix(".tiff"),)


@pytest.mark.parametrize("form", [_millimetres, _fifths_of_a_millimetre, _eight_bit, _float_picture])
def test_every_form_of_depth_gives_the_same_ball(tmp_path: Path, form: Callable[[Path], tuple[object, ...]]) -> None:
    result = run("range", *form(tmp_path / "scan"), *FOCAL, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "scan.surfaces.json").read_text())
    assert document["surfaces"][0]["type"] == "plane"
    balls = [s["parameters"] for s in document["surfaces"] if s["type"] in ("sphere", "ellipsoid")]
    assert len(balls) == 1
    np.testing.assert_allclose(balls[0]["centre_m"], [-0.07, 0.0, 0.58], atol=0.003)


def test_what_is_assumed_is_said(tmp_path: Path) -> None:
    result = run("range", *_millimetres(tmp_path / "scan"), "--out", tmp_path)
    assert "58 degrees" in result.output and "1 mm" in result.output
    assert len(json.loads((tmp_path / "scan.surfaces.json").read_text())["assumed"]) == 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--scale", "1", *FOCAL), "median depth"),  # millimetres are taken for metres
        (("--scale", "-1"), "not positive"),
        (("--pitch", "0.001", *FOCAL), "either orthographic"),
        (("--centre", "3,4"), "without a focal length"),
        (("--focal", "wide"), "not two numbers"),
        (("--focal", "0"), "not positive"),
        (("--near", "0.4"), "two ends"),
        (("--models", "missing.toml"), "missing.toml"),
    ],
)
def test_wrong_scales_and_sensors_are_refused_and_write_nothing(
    tmp_path: Path, words: tuple[str, ...], says: str
) -> None:
    (path,) = _millimetres(tmp_path / "scan")
    result = run("range", path, "--out", tmp_path / "out", *words)
    assert result.exit_code != 0 and says in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_eight_bits_without_a_window_are_refused(tmp_path: Path) -> None:
    path = _eight_bit(tmp_path / "scan")[0]
    assert "window" in str(run("range", path).exception)


def test_an_image_without_readings_says_so(tmp_path: Path) -> None:
    np.save(tmp_path / "dark.npy", np.full((40, 50), np.nan))
    assert isinstance(run("range", tmp_path / "dark.npy").exception, NotFound)


@needs_real
def test_the_real_desk_has_planes(tmp_path: Path) -> None:
    lens = ("--focal", "535.4,539.2", "--centre", "320.1,247.6", "--scale", "0.0002")
    result = run("range", REAL / "tum_fr3_1341848230.910894.png", "--out", tmp_path, *lens)
    assert result.exit_code == 0, result.output
    (document,) = [json.loads(path.read_text()) for path in tmp_path.glob("*.json")]
    largest = document["surfaces"][:4]  # partition, table, screen and floor
    assert [surface["type"] for surface in largest] == ["plane"] * 4
    assert all(0.5 < np.linalg.norm(surface["middle_m"]) < 4.0 and surface["pixels"] > 15_000 for surface in largest)


@needs_real
def test_the_real_mug_stands_on_a_plane(tmp_path: Path) -> None:
    result = run("range", REAL / "pcl_table_mug.npz", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "pcl_table_mug.surfaces.json").read_text())
    assert document["surfaces"][0]["type"] == "plane" and document["surfaces"][0]["pixels"] > 100_000


def test_a_batch_of_nothing_is_refused_before_any_worker_starts(tmp_path: Path) -> None:
    assert isinstance(run("batch", "range", tmp_path).exception, InvalidRequest)
    assert isinstance(run("batch", "range", tmp_path / "missing").exception, InvalidRequest)


@pytest.mark.slow
def test_a_batch_goes_on_and_writes_a_line_a_recording_and_tells_of_the_bad_one(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for k in range(3):
        np.save(folder / f"scan_{k}.npy", DEPTH_M)
    (folder / "scan_9.npz").write_bytes(b"nothing")
    out = tmp_path / "all.jsonl"
    earlier = KeptResults(out, folder, Reading(focal_px=(180.0, 180.0)))
    earlier.of(folder.iterdir())
    earlier.add([BatchResult(name="scan_2.npy", scene={"surfaces": []}, error=None)])
    result = run("batch", "range", folder, "--workers", 1, "--out", out, *FOCAL)
    assert result.exit_code == 1 and "3 of 4" in result.output and "scan_9.npz" in result.output
    assert f"continuing {earlier.part}" in result.output and not earlier.part.exists()
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [line["name"] for line in lines] == ["scan_0.npy", "scan_1.npy", "scan_2.npy", "scan_9.npz"]
    assert lines[0]["scene"] == lines[1]["scene"] and len(lines[0]["scene"]["surfaces"]) == 3
    assert lines[2]["scene"] == {"surfaces": []}
    assert lines[3]["scene"] is None and "InvalidRequest" in lines[3]["error"]


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_done_and_ends_calmly(tmp_path: Path) -> None:
    """A terminal sends SIGINT to every process of the batch."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    np.save(folder / "scan_0000.npy", DEPTH_M)
    for k in range(1, 2000):  # too many to be completed before the signal comes
        (folder / f"scan_{k:04d}.npy").hardlink_to(folder / "scan_0000.npy")
    out, part = tmp_path / "all.jsonl", tmp_path / "all.jsonl.part"
    words = [sys.executable, "-m", "service.cli", "batch", "range", folder, "--workers", "1", "--out", out, *FOCAL]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        eventually(lambda: process.poll() is not None or part.read_text().count("\n") > 1)
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate()[0]
    assert process.returncode == 130, said
    done = part.read_text().count("\n") - 1
    assert f"stopped: {done} of 2000 recordings done" in said and "run the same command to continue" in said
    assert 20 <= done < 2000 and "Traceback" not in said and "WARNING" not in said
