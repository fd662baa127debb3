"""What people and other programs get of a scene: JSON, a coloured picture, a coloured point cloud."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.range.analyse import RangeScene
from perception.range.primitives import Surface

Array = NDArray[np.float64]


def scene_json(scene: RangeScene) -> dict[str, Any]:
    """The scene as plain JSON values, SI units in the names, sensor frame."""
    return {
        "frame": "range_sensor",
        "noise_m_at_1_m": float(scene.noise.sigma_m(1.0)),
        "warnings": list(scene.warnings),
        "surfaces": [surface_json(s) for s in scene.surfaces],
    }


def surface_json(surface: Surface) -> dict[str, Any]:
    """One surface: type, parameters, covariance with the names of its rows, and figures of fit."""
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


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value if isinstance(value, bool) else float(value)


def colours(count: int) -> NDArray[np.uint8]:
    """(count + 1, 3) RGB colours, black for 0; neighbours in number differ in hue by the golden ratio."""
    hue = (np.arange(count + 1) * 0.61803398875) % 1.0 * 179
    value = np.where(np.arange(count + 1) % 2, 230, 180)
    hsv = np.stack([hue, np.full(count + 1, 170), value], axis=1).astype(np.uint8)
    rgb = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    rgb[0] = 0
    return np.asarray(rgb, np.uint8)


def picture(scene: RangeScene) -> NDArray[np.uint8]:
    """(H, W, 3) RGB image: one colour a surface, with its number and type written on it."""
    image = colours(len(scene.surfaces))[scene.labels].copy()
    for surface in scene.surfaces:
        v, u = np.nonzero(scene.labels == surface.label)
        if v.size < 60:
            continue
        k = int(np.argmin((u - np.median(u)) ** 2 + (v - np.median(v)) ** 2))
        text = f"{surface.label} {str(surface.type)[:3]}"
        cv2.putText(image, text, (int(u[k]) - 12, int(v[k]) + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1)
    return image


def write_png(path: Path, scene: RangeScene) -> None:
    """Write `picture` as PNG."""
    done, data = cv2.imencode(".png", cv2.cvtColor(picture(scene), cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"cannot encode {path}")
    path.write_bytes(data.tobytes())


def write_ply(path: Path, scene: RangeScene, depth_m: Array) -> None:
    """Write the valid points, metres in the sensor frame, coloured by surface, as binary PLY."""
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
