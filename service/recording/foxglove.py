"""Messages in Foxglove's well-known schemas, for recordings and for the live view.

https://docs.foxglove.dev/docs/sdk/schemas describes them; the classes come from `foxglove-schemas-protobuf`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.devices import DhLink, RangeScannerCapabilities

PNG_LEVEL = 1  # libpng's fastest: 3 % larger than its default on the bench cell's images, at a third of the time
DEPTH = "32FC1"
LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}


def stamp_of(time_ns: int) -> Timestamp:
    """Return Protobuf's time stamp of a time in nanoseconds since 1970."""
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)


@cache
def schema_of(kind: Any) -> bytes:
    """Return the schema of a Protobuf class as MCAP and Foxglove want it: a serialised `FileDescriptorSet`."""
    from mcap_protobuf.schema import build_file_descriptor_set

    data: bytes = build_file_descriptor_set(kind).SerializeToString()
    return data


def image_message(pixels: NDArray[np.uint8], *, frame: str, time_ns: int) -> CompressedImage:
    """Return a lossless PNG of an image, (H, W) gray or (H, W, 3) RGB."""
    shown = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".png", shown, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    return CompressedImage(timestamp=stamp_of(time_ns), frame_id=frame, data=data.tobytes(), format="png")


def pixels_of(message: CompressedImage) -> NDArray[np.uint8]:
    """Return the pixels of an `image_message`."""
    read: Any = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    return read if read.ndim == 2 else np.asarray(cv2.cvtColor(read, cv2.COLOR_BGR2RGB))


def depth_message(depth_m: NDArray[np.float32], *, frame: str, time_ns: int) -> RawImage:
    """Return a range image, (H, W) float32 m, bit by bit."""
    height, width = depth_m.shape
    data = np.ascontiguousarray(depth_m, "<f4")
    return RawImage(
        timestamp=stamp_of(time_ns),
        frame_id=frame,
        width=width,
        height=height,
        encoding=DEPTH,
        step=4 * width,
        data=data.tobytes(),
    )


def depth_of(message: RawImage) -> NDArray[np.float32]:
    """Return the range image of a `depth_message`."""
    return np.frombuffer(message.data, "<f4").reshape(message.height, message.width).copy()


def points_message(
    depth_m: NDArray[np.float32], c: RangeScannerCapabilities, *, frame: str, time_ns: int
) -> PointCloud:
    """Return the measured points of a range image in the scanner's frame; without those where nothing was measured."""
    xyz = np.ascontiguousarray(points_in_scanner(depth_m, c), "<f4")
    cloud = PointCloud(timestamp=stamp_of(time_ns), frame_id=frame, point_stride=12, data=xyz.tobytes())
    cloud.pose.orientation.w = 1.0
    for k, name in enumerate("xyz"):
        cloud.fields.add(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
    return cloud


def points_in_scanner(depth_m: NDArray[np.float32], c: RangeScannerCapabilities) -> Array:
    """Return the measured points, (N, 3) m, by the projections of `RangeScannerCapabilities`."""
    v, u = np.nonzero(np.isfinite(depth_m))
    r = depth_m[v, u].astype(float)
    if c.projection == "polar":
        angle = c.first_angle_rad + u * c.step_angle_rad
        return np.stack([r * np.sin(angle), 0.0 * r, r * np.cos(angle)], axis=1)
    x, y = (u - c.cx) / c.fx, (v - c.cy) / c.fy
    scale = r if c.projection == "pinhole" else np.ones_like(r)
    return np.stack([x * scale, y * scale, r], axis=1)


def calibration_message(lens: CameraIntrinsics, *, frame: str, time_ns: int) -> CameraCalibration:
    """Return the intrinsics of a camera; OpenCV's five coefficients are Foxglove's `plumb_bob`."""
    fx, fy, cx, cy = lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px
    return CameraCalibration(
        timestamp=stamp_of(time_ns),
        frame_id=frame,
        width=lens.width_px,
        height=lens.height_px,
        distortion_model="plumb_bob",
        D=lens.distortion,
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def joints_message(
    names: Sequence[str], position: Iterable[float], velocity: Iterable[float], *, time_ns: int
) -> JointStates:
    """Return positions and velocities of joints, rad and rad/s."""
    states = JointStates(timestamp=stamp_of(time_ns))
    for name, q, dq in zip(names, position, velocity, strict=True):
        states.joints.add(name=name, position=q, velocity=dq)
    return states


def transforms_message(links: Mapping[str, tuple[str, RigidTransform]], *, time_ns: int) -> FrameTransforms:
    """Return frames by name, each with its parent and `parent_from_frame`."""
    message = FrameTransforms()
    for child, (parent, pose) in links.items():
        x, y, z = np.asarray(pose.translation, float).tolist()
        qx, qy, qz, qw = np.asarray(pose.rotation.as_quat(), float).tolist()
        one = message.transforms.add(timestamp=stamp_of(time_ns), parent_frame_id=parent, child_frame_id=child)
        one.translation.x, one.translation.y, one.translation.z = x, y, z
        one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w = qx, qy, qz, qw
    return message


def log_message(text: str, *, name: str, time_ns: int, level: str = "info") -> Log:
    """Return a line for Foxglove's log panel."""
    return Log(timestamp=stamp_of(time_ns), level=LEVELS[level], message=text, name=name)


def base_from_flange(links: Sequence[DhLink], position_rad: Sequence[float]) -> RigidTransform:
    """Return the pose of the flange for joint angles in rad: the product of Rz(theta) Tz(d) Tx(a) Rx(alpha)."""
    pose = np.eye(4)
    for link, q in zip(links, position_rad, strict=True):
        c, s = np.cos(q + link.offset_rad), np.sin(q + link.offset_rad)
        ca, sa = np.cos(link.alpha_rad), np.sin(link.alpha_rad)
        pose = pose @ [
            [c, -s * ca, s * sa, link.a_m * c],
            [s, c * ca, -c * sa, link.a_m * s],
            [0.0, sa, ca, link.d_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    return RigidTransform.from_matrix(pose)


def is_picture(array: NDArray[Any]) -> bool:
    """Return whether an array is an image that `image_message` keeps to the bit."""
    is_shaped = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)
    return array.dtype == np.uint8 and is_shaped and bool(array.flags.c_contiguous) and array.size > 0
