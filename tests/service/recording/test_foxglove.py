"""The messages mean what Foxglove's documentation says, by readers that this project did not write."""

from __future__ import annotations

import io

import numpy as np
import pytest
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from PIL import Image as PillowImage
from scipy.spatial.transform import RigidTransform

from hal.calibration import CameraIntrinsics
from hal.devices import ArmCapabilities, DhLink, RangeScannerCapabilities
from manipulation import Kinematics
from perception.range import PinholeSensor
from service.recording import foxglove

RNG = np.random.default_rng(5)
DH = (  # d, a, alpha, offset
    (0.4, 0.0, -1.57, 0.1),
    (0.0, 0.4, 0.0, 0.0),
    (0.0, 0.0, 1.57, 0.0),
    (0.4, 0.0, -1.57, -0.3),
    (0.0, 0.0, 1.57, 0.0),
    (0.1, 0.02, 0.0, 0.0),
)


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3), (1, 1), (7, 5, 3)])
def test_an_image_is_a_lossless_png(shape: tuple[int, ...]) -> None:
    pixels = RNG.integers(0, 256, shape, np.uint8)
    message = foxglove.image_message(pixels, frame="camera", time_ns=1_500_000_000)
    assert (message.format, message.frame_id, message.timestamp.seconds) == ("png", "camera", 1)
    assert np.array_equal(np.asarray(PillowImage.open(io.BytesIO(message.data))), pixels)
    assert np.array_equal(foxglove.pixels_of(message), pixels)


def test_a_range_image_keeps_every_bit() -> None:
    depth = RNG.normal(size=(9, 11)).astype(np.float32)
    depth[2, 3] = np.nan
    message = foxglove.depth_message(depth, frame="scanner", time_ns=0)
    assert (message.encoding, message.step, len(message.data)) == ("32FC1", 44, message.step * message.height)
    assert foxglove.depth_of(message).tobytes() == depth.tobytes()


def scanner(projection: str, **given: float) -> RangeScannerCapabilities:
    size = {"width": 6, "height": 4, "fx": 5.0, "fy": 6.0, "cx": 2.5, "cy": 1.5}
    limits = {"min_range_m": 0.1, "max_range_m": 5.0, "sigma_m": 0.001, "rate_hz": 10.0}
    return RangeScannerCapabilities(projection=projection, **{**size, **limits, **given})  # type: ignore[arg-type]


def test_a_point_cloud_holds_the_measured_points_in_the_scanners_frame() -> None:
    depth = RNG.uniform(0.5, 2.0, (4, 6)).astype(np.float32)
    depth[0, 0] = np.nan
    message = foxglove.points_message(depth, scanner("pinhole"), frame="scanner", time_ns=0)
    assert [(f.name, f.offset, f.type) for f in message.fields] == [
        (name, 4 * k, PackedElementField.FLOAT32) for k, name in enumerate("xyz")
    ]
    points = np.frombuffer(message.data, "<f4").reshape(-1, 3)
    assert message.point_stride * len(points) == len(message.data)
    sensor = PinholeSensor(width_px=6, height_px=4, fx_px=5.0, fy_px=6.0, cx_px=2.5, cy_px=1.5)
    u, v = sensor.fx_px * points[:, 0] / points[:, 2] + 2.5, sensor.fy_px * points[:, 1] / points[:, 2] + 1.5
    assert len(points) == depth.size - 1
    assert np.allclose(depth[np.rint(v).astype(int), np.rint(u).astype(int)], points[:, 2])


def test_points_of_the_other_projections_are_where_the_interface_says() -> None:
    depth = np.full((4, 6), 2.0, np.float32)
    points = foxglove.points_in_scanner(depth, scanner("orthographic"))
    assert points[0].tolist() == [-0.5, -0.25, 2.0]
    line = np.array([[1.0, np.nan, 2.0]], np.float32)
    polar = foxglove.points_in_scanner(line, scanner("polar", first_angle_rad=-0.5, step_angle_rad=0.5))
    assert np.allclose(polar, [[np.sin(-0.5), 0.0, np.cos(-0.5)], [2 * np.sin(0.5), 0.0, 2 * np.cos(0.5)]])


def test_the_flange_is_where_the_kinematics_put_it() -> None:
    links = tuple(DhLink(d_m=d, a_m=a, alpha_rad=alpha, offset_rad=offset) for d, a, alpha, offset in DH)
    q = RNG.normal(size=6)
    arm = ArmCapabilities(
        model="test",
        links=links,
        lower_rad=(-3.0,) * 6,
        upper_rad=(3.0,) * 6,
        velocity_rad_per_s=(1.0,) * 6,
        acceleration_rad_per_s2=(1.0,) * 6,
        tip_speed_m_per_s=1.0,
        command_rate_hz=100.0,
        link_radius_m=(0.05,) * 6,
    )
    expected = Kinematics.of(arm).tool(q, RigidTransform.identity()).as_matrix()
    assert np.allclose(foxglove.base_from_flange(links, q.tolist()).as_matrix(), expected, atol=1e-12)


def test_a_frame_maps_a_point_of_the_child_into_the_parent() -> None:
    pose = RigidTransform.from_components([1.0, 2.0, 3.0], foxglove.base_from_flange((), []).rotation)
    message = foxglove.transforms_message({"flange": ("base", pose)}, time_ns=3)
    (one,) = message.transforms
    assert (one.parent_frame_id, one.child_frame_id, one.timestamp.nanos) == ("base", "flange", 3)
    assert (one.translation.x, one.translation.y, one.translation.z, one.rotation.w) == (1.0, 2.0, 3.0, 1.0)


def test_a_calibration_has_the_matrices_that_foxglove_describes() -> None:
    lens = CameraIntrinsics(width_px=64, height_px=48, fx_px=50.0, fy_px=51.0, cx_px=31.0, cy_px=23.0)
    message = foxglove.calibration_message(lens, frame="camera", time_ns=0)
    assert np.reshape(message.K, (3, 3)).tolist() == [[50.0, 0.0, 31.0], [0.0, 51.0, 23.0], [0.0, 0.0, 1.0]]
    assert np.reshape(message.P, (3, 4))[:, :3].tolist() == np.reshape(message.K, (3, 3)).tolist()
    assert message.distortion_model == "plumb_bob"


@pytest.mark.parametrize(
    ("array", "is_picture"),
    [
        (np.zeros((2, 3), np.uint8), True),
        (np.zeros((2, 3, 3), np.uint8), True),
        (np.zeros((2, 3, 4), np.uint8), False),
        (np.zeros((0, 3), np.uint8), False),
        (np.zeros((2, 3), np.uint16), False),
        (np.zeros((4, 6), np.uint8)[:, ::2], False),
    ],
)
def test_only_what_a_png_keeps_to_the_bit_becomes_one(array: object, is_picture: bool) -> None:
    assert foxglove.is_picture(array) is is_picture  # type: ignore[arg-type]
