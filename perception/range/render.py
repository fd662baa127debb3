"""Output of a scene as JSON, as a coloured picture and as a coloured point cloud."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hal.arrays import Array, Image
from hal.geometry import to_json
from perception.range.analysis import RangeScene
from perception.range.matching.match import Match
from perception.range.primitives import Surface

MARK = ".surfaces"  # in the names of pictures drawn of a recording, so that a batch does not take them for recordings
PICTURE_PX = 768  # smaller images are enlarged to about this size, so that text in them is legible
LEAST_WRITTEN_PX = 500  # smaller surfaces in a picture get no text


def scene_json(scene: RangeScene, matches: Sequence[Match] | None = None) -> dict[str, Any]:
    """Return the scene as plain JSON values, in SI units (named in the keys) and in the sensor frame.

    Args:
        matches: the component models that were looked for; the key `components` is left out where there are None.
    """
    components = {} if matches is None else {"components": [_match_json(match) for match in matches]}
    return {
        "frame": "range_sensor",
        "noise_m_at_1_m": float(scene.noise.sigma_m(1.0)),
        "warnings": list(scene.warnings),
        "surfaces": [surface_json(s) for s in scene.surfaces],
        **components,
    }


def surface_json(surface: Surface) -> dict[str, Any]:
    """Return type, parameters, covariance with the names of its rows, and residuals of one surface as JSON values."""
    parameters = {
        field.name: _plain(getattr(surface.primitive, field.name)) for field in dataclasses.fields(surface.primitive)
    }
    return {
        "label": surface.label,
        "type": str(surface.type),
        "pixels": surface.pixels,
        "rms_m": surface.rms_m,
        "misfit": surface.misfit,
        "middle_m": _plain(surface.middle_m),
        "parameters": parameters,
        "covariance_over": list(surface.covariance_over),
        "covariance": _plain(surface.covariance),
    }


def _match_json(match: Match) -> dict[str, Any]:
    """Return a match as JSON values: pose with covariance (6x6 as `UncertainPose`), surfaces, state, free turns."""
    pose = match.sensor_from_object
    return {
        "model": match.model,
        "sensor_from_object": {**to_json(pose.parent_from_child), "covariance": pose.covariance.tolist()},
        "surfaces": match.labels,
        "state": match.state,
        "state_sigma": match.state_sigma,
        "free": list(match.free),
        "score": match.score,
    }


def _plain(value: Any) -> Any:
    """Return an array as a list, a boolean unchanged, and any other number as a float."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value if isinstance(value, bool) else float(value)


def colours(count: int) -> Image:
    """Return RGB colours (count + 1, 3), black for 0; the hues of successive numbers differ by the golden ratio."""
    hue = (np.arange(count + 1) * 0.61803398875) % 1.0 * 179
    value = np.where(np.arange(count + 1) % 2, 230, 180)
    hsv = np.stack([hue, np.full(count + 1, 170), value], axis=1).astype(np.uint8)
    rgb = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    rgb[0] = 0
    return np.asarray(rgb, np.uint8)


def picture(scene: RangeScene) -> Image:
    """Return an RGB image (sH, sW, 3) with one colour per surface and its number and type; s enlarges small images."""
    labels = scene.labels
    scale = max(1, PICTURE_PX // max(labels.shape))
    image = np.kron(colours(len(scene.surfaces))[labels], np.ones((scale, scale, 1), np.uint8))
    for surface in scene.surfaces:
        inside = np.pad((labels == surface.label).astype(np.uint8), 1)
        if int(inside.sum()) * scale**2 < LEAST_WRITTEN_PX:
            continue
        # The text goes where the surface is widest, because its middle may be hidden by another surface.
        _, radius_px, _, (u, v) = cv2.minMaxLoc(cv2.distanceTransform(inside, cv2.DIST_L2, 3))
        _write(image, surface, scale * (u - 1), scale * (v - 1), room_px=2.0 * scale * radius_px)
    return image


def _write(image: Image, surface: Surface, u_px: int, v_px: int, *, room_px: float) -> None:
    """Write number and type of a surface around (u, v), in white letters with a dark rim.

    `room_px`: width of the surface there; the type is shortened if it does not fit.
    """
    text = f"{surface.label} {surface.type}"
    if cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)[0][0] > room_px:
        text = f"{surface.label} {str(surface.type)[:3]}"
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)
    at = (u_px - width // 2, v_px + height // 2)
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, thickness, cv2.LINE_AA)


def write_png(path: Path, scene: RangeScene) -> None:
    """Write `picture` as a PNG file."""
    done, data = cv2.imencode(".png", cv2.cvtColor(picture(scene), cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"cannot encode {path}")
    path.write_bytes(data.tobytes())


def write_ply(path: Path, scene: RangeScene, depth_m: Array) -> None:
    """Write the valid points of an image, metres in the sensor frame, coloured by surface, as a binary PLY file."""
    points = scene.sensor.points(np.asarray(depth_m, float)).reshape(-1, 3)
    valid = np.isfinite(points[:, 2])
    records = np.empty(int(valid.sum()), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    records["xyz"] = points[valid]
    records["rgb"] = colours(len(scene.surfaces))[scene.labels.ravel()[valid]]
    names = "".join(f"property float {a}\n" for a in "xyz") + "".join(
        f"property uchar {c}\n" for c in ("red", "green", "blue")
    )
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {records.size}\n{names}end_header\n"
    path.write_bytes(head.encode("ascii") + records.tobytes())
