"""Tests of `panelwright calibrate board` with drawn photographs of boards, and with other files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from hal.calibration import load_calibration
from perception.calibration.boards import Charuco
from service.cli import _app
from tests.perception.calibration.test_intrinsics import drawn


def run(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(_app(), ["calibrate", "board", *(str(word) for word in words)])
    return done.exit_code, done.output + (repr(done.exception) if done.exception else "")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, board = tmp_path_factory.mktemp("board"), Charuco()
    size_m = (board.columns * board.square_m, board.rows * board.square_m)
    paths = []
    for seed in range(8):
        path = folder / f"{seed}.png"
        cv2.imwrite(str(path), drawn(board.draw(80), size_m, seed))
        paths.append(path)
    return paths


def test_a_board_gives_a_record_that_keeps_the_mount_and_counts_up(photographs: list[Path], tmp_path: Path) -> None:
    out, blank = tmp_path / "camera.toml", tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((480, 640), 200, np.uint8))
    code, text = run(*photographs, blank, "--out", out)
    assert code == 0, text
    assert "8 of 9 images used" in text and f"left out {blank}" in text
    record = load_calibration(out)
    assert record.version == 1 and record.intrinsics is not None and record.intrinsics.rms_px < 0.5
    out.write_text(out.read_text() + "\n[mount]\nposition_m = [0.0, 0.0, 0.1]\nrpy_rad = [0.0, 0.0, 0.0]\n")
    assert run(*photographs, "--out", out)[0] == 0
    again = load_calibration(out)
    assert again.version == 2 and again.mount is not None and again.intrinsics == record.intrinsics


def test_what_cannot_be_calibrated_from_is_refused_and_writes_nothing(photographs: list[Path], tmp_path: Path) -> None:
    out, small, text_file = tmp_path / "camera.toml", tmp_path / "small.png", tmp_path / "text.png"
    cv2.imwrite(str(small), np.full((100, 120), 200, np.uint8))
    text_file.write_text("no image")
    for words, why in (
        ((*photographs, small), "different sizes"),
        ((*photographs, text_file), "not an image"),
        ((*photographs, tmp_path / "nowhere.png"), "cannot be read"),
        (photographs[:2], "show the board"),
        ((*photographs, "--kind", "dots"), "show the board"),
        ((*photographs, "--marker", "0.05"), "do not fit"),
    ):
        code, text = run(*words, "--out", out)
        assert code != 0 and why in text, text
    assert not out.exists()
