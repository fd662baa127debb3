"""The Python code of the pages runs unchanged; the tests supply the values that a page leaves to the reader."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.simcell import open_bench
from fusion.sensing import Pinhole
from hal.calibration import CameraIntrinsics
from hal.geometry import UncertainPose
from manipulation.skills.outcome import Outcome
from perception.range import SurfaceType
from tests.docs.blocks import ROOT

FACING = Rotation.from_matrix(
    [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
)  # a camera that looks down on z = 0
LENS = CameraIntrinsics(width_px=640, height_px=480, fx_px=460.0, fy_px=460.0, cx_px=319.5, cy_px=239.5)
LIGHTS_M = np.array([[-0.28, 0.18, 0.0], [0.28, 0.18, 0.0], [0.28, -0.18, 0.0], [-0.28, -0.18, 0.0]])
CAMERA_FROM_PANEL = RigidTransform.from_components(
    [0.01, -0.005, 0.62], Rotation.from_euler("xyz", [8.0, -12.0, 4.0], degrees=True) * FACING
)


def run(page: str, **given: Any) -> dict[str, Any]:
    """Return all names defined after the first Python block of `docs/page`."""
    block = re.search(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    assert block is not None
    names = dict(given)
    exec(compile(block[1], page, "exec"), names)  # noqa: S102 - our own pages
    return names


def placed(x_m: float, y_m: float, z_m: float, *, facing: Rotation | None = None, sigma: float = 1e-6) -> UncertainPose:
    pose = RigidTransform.from_components([x_m, y_m, z_m], facing or Rotation.identity())
    return UncertainPose(parent_from_child=pose, covariance=sigma**2 * np.eye(6))


def test_the_range_page_finds_its_wall() -> None:
    found = run("explanation/range.md")
    assert found["wall"].type is SurfaceType.PLANE
    tilt_rad = np.arccos(abs(found["fit"].feature.direction @ found["wall"].primitive.normal))
    assert tilt_rad < 1e-4
    assert abs(abs(found["wall"].primitive.normal[0]) - 0.2 / np.hypot(1.0, 0.2)) < 1e-4


def test_the_fusion_page_fuses_an_edge_and_a_touch() -> None:
    focal_px, height_m, row_px = 460.0, 0.8, 374.0  # the centre row of the edge in the page
    camera = Pinhole(fx_px=focal_px, fy_px=focal_px, cx_px=319.5, cy_px=239.5)
    above_m = height_m * (row_px - camera.cy_px) / focal_px
    base_from_camera = placed(0.4, above_m, height_m, facing=FACING)
    found = run(
        "explanation/fusion.md",
        camera=camera,
        base_from_camera=base_from_camera,
        base_from_finger=placed(0.4, 0.25, 0.001),  # a millimetre in front of the assumed face
        pose_from_the_lights=placed(0.0, 0.0, 0.0, sigma=0.05),
    )
    answer = found["answer"]
    assert not answer.rejected
    x, y, z = base_from_camera.parent_from_child.inv().apply(answer.pose.apply([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0]])).T
    u_px, v_px = camera.cx_px + focal_px * x / z, camera.cy_px + focal_px * y / z
    np.testing.assert_allclose(np.polyval(np.polyfit(u_px, v_px, 1), [102.0, 511.0]), [377.0, 371.0], atol=0.1)
    assert answer.pose.apply([0.4, 0.25, 0.0])[2] == pytest.approx(0.001, abs=1e-4)


def test_the_pose_page_finds_the_drawn_panel() -> None:
    found = run(
        "explanation/panel-pose.md",
        image_off=drawn(lit=False),
        image_on=drawn(lit=True),
        lights_m=LIGHTS_M,
        intrinsics=LENS,
    )
    pose = found["seen"].pose
    miss = pose.camera_from_object * CAMERA_FROM_PANEL.inv()
    assert np.linalg.norm(miss.translation) < 0.002
    assert miss.rotation.magnitude() < np.radians(0.5)
    assert pose.covariance.shape == (6, 6)
    assert not pose.ambiguous


def drawn(*, lit: bool) -> NDArray[np.uint8]:
    """Return an image by `LENS` of a panel of squares, with its four lights off or on."""
    rng = np.random.default_rng(5)
    image = np.full((LENS.height_px, LENS.width_px), 90, np.uint8)
    for _ in range(25):
        corner = rng.integers([100, 100], [500, 340])
        size = rng.integers(10, 40, 2)
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), int(rng.integers(30, 150)), -1)
    x, y, z = CAMERA_FROM_PANEL.apply(LIGHTS_M).T
    for u_px, v_px in zip(LENS.cx_px + LENS.fx_px * x / z, LENS.cy_px + LENS.fy_px * y / z, strict=True):
        centre = (round(16 * u_px), round(16 * v_px))
        cv2.circle(image, centre, 16 * 5, 230 if lit else 60, -1, cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.uint8)


@pytest.mark.slow
def test_the_manipulation_page_opens_the_valve() -> None:
    bench = open_bench(106)
    try:
        assert bench.truth("main_valve").state == "closed"
        found = run(
            "explanation/manipulation.md",
            context=bench.context,
            known=bench.look("main_valve"),
            look_again=lambda: bench.look("main_valve"),
        )
        assert found["report"].outcome is Outcome.DONE
        assert found["report"].seen.state == "open"
        assert bench.truth("main_valve").state == "open"
    finally:
        bench.close()


def test_the_tutorial_teaches_a_mushroom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kinds").mkdir()
    run("tutorials/teach-a-kind.md")
    assert (tmp_path / "kinds" / "mushroom.toml").is_file()
    assert re.search(r"^mushroom (1\.0|0\.99)", capsys.readouterr().out, flags=re.MULTILINE)
