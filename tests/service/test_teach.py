"""`panelwright teach`: a kind that did not exist before is known after two clicks, and bad input writes nothing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.errors import InvalidRequest
from perception.vision.knowledge import load_knowledge, shipped_knowledge
from perception.vision.view import CameraView
from service.commands.teach import teach
from tests.perception.vision.bench_panel import panel, scene


def _example(path: Path) -> list[str]:
    """Write an overview to `path` and return two clicks around its emergency mushroom."""
    image, intrinsics, pose = scene(tilt_deg=5.0, distance_m=0.66, pose_error=0.0)
    cv2.imwrite(str(path), image)
    view = CameraView(intrinsics=intrinsics, camera_from_panel=pose)
    corners = panel().object("emergency").point_m + np.array([[-0.02, 0.02, 0.0], [0.02, -0.02, 0.0]])
    return [f"{u:.2f},{v:.2f}" for u, v in view.project(corners)]


def test_a_new_kind_is_found_after_two_clicks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clicks, folder = _example(tmp_path / "panel.png"), tmp_path / "kinds"
    assert shipped_knowledge().kind("mushroom") is None
    teach(tmp_path / "panel.png", folder=folder, kind="mushroom", click=clicks)
    assert [kind.name for kind in load_knowledge(folder).kinds] == ["mushroom"]
    capsys.readouterr()
    teach(tmp_path / "panel.png", folder=folder, check=True)
    found = [line for line in capsys.readouterr().out.splitlines() if "confidence" in line]
    assert sum(line.startswith("mushroom at") for line in found) == 1


@pytest.mark.parametrize("bad", [["nan,1"], ["1"], ["1e9,3"], ["a,b"], []])
def test_bad_clicks_are_refused_and_write_nothing(tmp_path: Path, bad: list[str]) -> None:
    _example(tmp_path / "panel.png")
    with pytest.raises(InvalidRequest):
        teach(tmp_path / "panel.png", folder=tmp_path / "kinds", kind="mushroom", click=bad)
    assert not (tmp_path / "kinds").exists()


def test_a_name_that_leaves_the_folder_is_refused(tmp_path: Path) -> None:
    clicks = _example(tmp_path / "panel.png")
    with pytest.raises(InvalidRequest, match="no name of a kind"):
        teach(tmp_path / "panel.png", folder=tmp_path / "kinds", kind="../up", click=clicks)
