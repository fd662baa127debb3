"""Rims of objects in drawn images: in their places, at heights that the panel file does not state, and hidden."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.vision_drawing import looking_at
from hal.camera_model import project
from hal.panel import Panel, PanelObject
from perception.vision import RimView, find_rims
from tests.perception.vision.bench_panel import panel, scene

TILT_DEG, AZIMUTH_DEG = 12.0, 40.0
DRAWN_ABOVE_M = {"ready": 0.006}  # its lens is drawn that far out of the plate; the panel file has a lens's foot at it


def built_with(name: str, **changes: object) -> Panel:
    """The panel file with another description of one object than the image shows."""
    file = panel()
    objects = tuple(one.model_copy(update=changes) if one.name == name else one for one in file.objects)
    return file.model_copy(update={"objects": objects})


def rim_point(one: PanelObject) -> np.ndarray:
    assert one.rim is not None
    return np.array([*one.position_m, one.rim.above_plate_m])


def drawn_point(one: PanelObject) -> np.ndarray:
    return rim_point(one) + np.array([0.0, 0.0, DRAWN_ABOVE_M.get(one.name, 0.0)])


def rims_by_file(file: Panel) -> tuple[dict[str, RimView], dict[str, np.ndarray]]:
    """What is found with a panel file, and where the rims of the drawn panel really are, px."""
    image, intrinsics, pose = scene(tilt_deg=TILT_DEG, azimuth_deg=AZIMUTH_DEG)
    truth = RigidTransform.from_matrix(
        looking_at(distance_m=0.62, tilt_rad=np.deg2rad(TILT_DEG), azimuth_rad=np.deg2rad(AZIMUTH_DEG))
    )
    true_px = {
        one.name: project(truth.apply(drawn_point(one))[None], intrinsics)[0]
        for one in panel().objects
        if one.rim is not None
    }
    return {view.name: view for view in find_rims(image, intrinsics, pose, file)}, true_px


def test_every_rim_is_found_in_its_place_within_its_covariance() -> None:
    found, true_px = rims_by_file(panel())
    assert set(found) == set(true_px)
    for name, view in found.items():
        off = view.pixel_px - true_px[name]
        assert off @ np.linalg.solve(view.covariance_px + view.built_covariance_px, off) < 9.2, (name, off)  # 1 %
        np.testing.assert_array_equal(view.point_m, rim_point(panel().object(name)))


@pytest.mark.parametrize("off_m", [0.012, -0.012])
def test_a_rim_at_a_height_that_the_file_does_not_state_is_still_seen_where_it_is(off_m: float) -> None:
    height_m = panel().object("drain").height_m
    found, true_px = rims_by_file(built_with("drain", height_m=height_m + off_m))
    assert np.linalg.norm(found["drain"].pixel_px - true_px["drain"]) < 2.0
    assert found["drain"].point_m[2] == pytest.approx(rim_point(panel().object("drain"))[2] + off_m)


def test_an_uncertain_height_widens_the_place_by_its_share_in_the_view() -> None:
    found, _ = rims_by_file(panel())
    assert np.trace(found["mode"].built_covariance_px) > 10.0 * np.trace(found["pressure"].built_covariance_px)


def test_what_is_not_there_and_what_has_no_rim_is_not_found() -> None:
    found, _ = rims_by_file(built_with("ready", position_m=(-0.25, -0.05)))
    assert "ready" not in found
    assert not {"start", "power", "speed", "inlet", "emergency"} & set(found)
