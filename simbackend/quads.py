"""Flat pictures for the engine: an OBJ mesh with texture coordinates and a PNG beside it.

A texture on one of the engine's own boxes shows a corner of the picture only; a mesh with coordinates shows all of it.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from simbackend.panel_model import Quad

DISC_CORNERS = 72


def write_quad(folder: Path, name: str, quad: Quad) -> tuple[Path, Path]:
    """Write mesh and picture; returns their paths. The mesh lies in z = 0 and faces +z."""
    mesh, picture = folder / f"{name}.obj", folder / f"{name}.png"
    cv2.imwrite(str(picture), quad.pixels[:, :, ::-1])
    corners = _disc() if quad.is_round else np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    w, h = quad.size_m
    lines = [f"v {x * w / 2!r} {y * h / 2!r} 0" for x, y in corners.tolist()]
    lines += [f"vt {(x + 1) / 2!r} {(y + 1) / 2!r}" for x, y in corners.tolist()]
    lines.append("vn 0 0 1")
    lines += [f"f 1/1/1 {i}/{i}/1 {i + 1}/{i + 1}/1" for i in range(2, len(corners))]
    mesh.write_text("\n".join(lines) + "\n", encoding="ascii")
    return mesh, picture


def _disc() -> np.ndarray:
    angles = 2.0 * np.pi * np.arange(DISC_CORNERS) / DISC_CORNERS
    return np.column_stack([np.cos(angles), np.sin(angles)])
