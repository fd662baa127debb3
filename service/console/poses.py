"""Poses of the cell's frames as the service gives them, and the lens of a camera."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.calibration import CameraIntrinsics
from hal.geometry import from_json
from service.console.mirror import Mirror

MOVED_M = 0.0005  # the flange has moved between two looks: the picture and the outlines do not belong together


def frames_of(mirror: Mirror) -> dict[str, dict[str, Any]]:
    """Return the known frames by the name of the child."""
    return {frame["child"]: frame for frame in mirror.said("frames", {"frames": []})["frames"]}


def base_from(frames: dict[str, dict[str, Any]], name: str) -> RigidTransform | None:
    """Return the pose of a frame in the base; None if it or a parent of it is not known."""
    pose = RigidTransform.identity()
    while name != "base":
        frame = frames.get(name)
        if frame is None:
            return None
        pose = from_json(frame) * pose
        name = frame["parent"]
    return pose


def camera_from_panel(mirror: Mirror, camera: str) -> RigidTransform | None:
    """Return where a camera sees the panel; None before the panel was located or without the arm's pose."""
    frames = frames_of(mirror)
    base_from_camera, base_from_panel = base_from(frames, camera), base_from(frames, "panel")
    if base_from_camera is None or base_from_panel is None:
        return None
    return base_from_camera.inv() * base_from_panel


def lens_of(mirror: Mirror, camera: str) -> CameraIntrinsics | None:
    """Return the lens of a camera from its calibration record; None if it has none."""
    for record in mirror.said("calibrations", {"calibrations": []})["calibrations"]:
        if record["device"] == camera and record["intrinsics"] is not None:
            told = record["intrinsics"]
            numbers = {field.name: told[field.name] for field in fields(CameraIntrinsics) if field.name in told}
            return CameraIntrinsics(**{**numbers, "distortion": tuple(told["distortion"])})
    return None


def has_moved(before: RigidTransform | None, after: RigidTransform | None) -> bool:
    """Return whether two poses differ by more than the noise of standing still."""
    if before is None or after is None:
        return before is not after
    return float(np.linalg.norm(before.translation - after.translation)) > MOVED_M
