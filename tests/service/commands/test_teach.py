"""`panelwright teach`: a kind that did not exist before is known after two clicks, and bad input writes nothing."""

from __future__ import annotations

import io
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.errors import InvalidRequest, NotFound
from hal.panel import load_panel
from perception.vision.knowledge_files import load_knowledge
from perception.vision.projection import CameraProjection
from service.commands.teach import teach
from tests.perception.vision.bench_panel import panel, scene


def _example(path: Path) -> list[str]:
    """Write an overview to `path` and return two clicks around its emergency mushroom."""
    image, intrinsics, pose = scene(tilt_deg=5.0, distance_m=0.66, pose_error=0.0)
    cv2.imwrite(str(path), image)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    corners = panel().object("emergency").point_m + np.array([[-0.02, 0.02, 0.0], [0.02, -0.02, 0.0]])
    return [f"{u:.2f},{v:.2f}" for u, v in view.project(corners)]


def test_a_new_kind_is_found_after_two_clicks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clicks, folder = _example(tmp_path / "panel.png"), tmp_path / "kinds"
    assert load_knowledge().kind("mushroom") is None
    teach(tmp_path / "panel.png", folder=folder, kind="mushroom", click=clicks)
    assert [kind.name for kind in load_knowledge(folder).kinds] == ["mushroom"]
    capsys.readouterr()
    teach(tmp_path / "panel.png", folder=folder, check=True)
    found = [line for line in capsys.readouterr().out.splitlines() if "confidence" in line]
    assert sum(line.startswith("mushroom at") for line in found) == 1


def test_four_corners_serve_where_the_border_is_not_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image, intrinsics, pose = scene(tilt_deg=5.0, distance_m=0.66, pose_error=0.0)
    view, size = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose), panel()
    half_m = np.array([size.width_m, size.height_m, 0.0]) / 2
    corners_px = view.project(half_m * [[1, 1, 0], [-1, -1, 0], [-1, 1, 0], [1, -1, 0]])
    clicks_px = view.project(size.object("emergency").point_m + np.array([[-0.02, 0.02, 0.0], [0.02, -0.02, 0.0]]))
    room = np.full((2 * image.shape[0], 2 * image.shape[1]), 120, np.uint8)  # the plate fills less than a quarter
    room[100 : 100 + image.shape[0], 150 : 150 + image.shape[1]] = image
    cv2.imwrite(str(tmp_path / "room.png"), room)
    corners, clicks = ([f"{u + 150:.1f},{v + 100:.1f}" for u, v in points] for points in (corners_px, clicks_px))
    with pytest.raises(NotFound, match="plate"):
        teach(tmp_path / "room.png", folder=tmp_path / "kinds", kind="mushroom", click=clicks)
    teach(tmp_path / "room.png", folder=tmp_path / "kinds", kind="mushroom", click=clicks, corner=corners)
    capsys.readouterr()
    teach(tmp_path / "room.png", folder=tmp_path / "kinds", check=True, corner=corners)
    found = [line for line in capsys.readouterr().out.splitlines() if "confidence" in line]
    assert len(found) >= 0.8 * len(size.objects) and sum(line.startswith("mushroom at") for line in found) == 1


@pytest.mark.parametrize(
    "bad",
    [["10,10"], ["10,10", "20,20", "30,30", "40,40"], ["0,0", "90,0", "0,90", "20,20"], ["1,1", "a", "2,2", "3,3"]],
)
def test_corners_that_cannot_be_are_refused(tmp_path: Path, bad: list[str]) -> None:
    clicks = _example(tmp_path / "panel.png")
    with pytest.raises(InvalidRequest, match="corner"):
        teach(tmp_path / "panel.png", folder=tmp_path / "kinds", kind="mushroom", click=clicks, corner=bad)
    assert not (tmp_path / "kinds").exists()


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


def _talk(monkeypatch: pytest.MonkeyPatch, *lines: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{line}\n" for line in lines)))


def _pixels(name: str, half_m: float = 0.0) -> str:
    """Return clicks on an object of the example: its centre, or two corners."""
    _, intrinsics, pose = scene(tilt_deg=5.0, distance_m=0.66, pose_error=0.0)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    steps = [[0.0, 0.0, 0.0]] if half_m == 0.0 else [[-half_m, half_m, 0.0], [half_m, -half_m, 0.0]]
    return " ".join(f"{u:.1f},{v:.1f}" for u, v in view.project(np.array(panel().object(name).point_m) + steps))


def test_the_dialogue_teaches_a_kind_and_shows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _example(tmp_path / "panel.png")
    clicks = _pixels("emergency", 0.02)
    _talk(monkeypatch, "kind", "somewhere", "3,3", clicks, "no", clicks, "", "Not A Name", "no", "mushroom", "no")
    teach(tmp_path / "panel.png", folder=tmp_path / "kinds", dialogue=True)
    said = capsys.readouterr().out
    assert "is not pixels" in said and "beside the plate" in said and "is no name" in said
    assert "'no' cannot be a name" in said
    assert "found a circle of 40 x 40 mm" in said
    assert sum(line.startswith("mushroom at") for line in said.splitlines()) == 1
    assert [kind.name for kind in load_knowledge(tmp_path / "kinds").kinds] == ["mushroom"]


def test_the_dialogue_teaches_a_whole_panel_and_reads_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _example(tmp_path / "panel.png")
    gauge = [_pixels("pressure"), "yes", "gauge", "pressure", "much", "0", "10", "bar", "-135", "135", "yes"]
    knob = [_pixels("mode"), "yes", "", "mode", "off=-45.8, low, high", "off=-45.8, low=0, high=45.8", "yes"]
    stop = [_pixels("emergency"), "yes", "mushroom", "pressure", "halt", "no"]
    _talk(monkeypatch, "panel", "pump_room", "", *gauge, *knob, *stop)
    teach(tmp_path / "panel.png", folder=tmp_path / "kinds", dialogue=True)
    said = capsys.readouterr().out
    assert "must be a number" in said and "there is a 'pressure' already" in said
    made = load_panel(tmp_path / "kinds" / "panels" / "pump_room.toml")
    assert [(panel_object.name, panel_object.kind) for panel_object in made.objects] == [
        ("pressure", "gauge"), ("mode", "rotary"), ("halt", "mushroom"),
    ]  # fmt: skip
    assert "mode (rotary): high" in said
    assert re.search(r"pressure \(gauge\): 6\.[1-5]", said)


def test_a_script_that_ends_too_early_or_never_makes_sense_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _example(tmp_path / "panel.png")
    for lines, words in ((["kind", _pixels("emergency")], "ended before"), (["kind", *["?"] * 9], "not pixels")):
        _talk(monkeypatch, *lines)
        with pytest.raises(InvalidRequest, match=words):
            teach(tmp_path / "panel.png", folder=tmp_path / "kinds", dialogue=True)
    _talk(monkeypatch)
    with pytest.raises(InvalidRequest, match="there is no terminal"):
        teach(tmp_path / "panel.png", folder=tmp_path / "kinds")
    with pytest.raises(InvalidRequest, match=r"pane\.png"):  # before it asks questions
        teach(tmp_path / "pane.png", folder=tmp_path / "kinds")
    assert not (tmp_path / "kinds").exists()
