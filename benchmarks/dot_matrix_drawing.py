"""Draws photographs of dot-matrix displays with known texts: LED, LCD and vacuum fluorescent ones, round and square dots."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.display_photo import Gray, disturbed, surroundings, taken
from hal.arrays import Array
from perception.vision.projection import homography

# The usual characters of 5 x 7 dots, row by row from the top; a digit may have one of several forms.
PATTERNS = {
    "0": ("01110 10001 10011 10101 11001 10001 01110", "01110 10001 10001 10001 10001 10001 01110"),
    "1": ("00100 01100 00100 00100 00100 00100 01110",),
    "2": ("01110 10001 00001 00010 00100 01000 11111", "01110 10001 00001 00110 01000 10000 11111"),
    "3": ("11111 00010 00100 00010 00001 10001 01110", "01110 10001 00001 00110 00001 10001 01110"),
    "4": ("00010 00110 01010 10010 11111 00010 00010",),
    "5": ("11111 10000 11110 00001 00001 10001 01110",),
    "6": ("00110 01000 10000 11110 10001 10001 01110",),
    "7": ("11111 00001 00010 00100 01000 01000 01000",),
    "8": ("01110 10001 10001 01110 10001 10001 01110",),
    "9": ("01110 10001 10001 01111 00001 00010 01100",),
    "-": ("00000 00000 00000 11111 00000 00000 00000",),
    ".": ("00000 00000 00000 00000 00000 01100 01100",),
}
CELL_PX = 24  # of a dot, when drawn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DotCase:
    """A photograph (H, W) uint8 of a dot-matrix display, its text, and the height of a character in it."""

    image: Gray
    text: str
    high_px: float


def draw_dots(seed: int, *, scene: bool = False) -> DotCase:
    """Draw a display of random design, the same for the same seed, cropped or with things around it."""
    random = np.random.default_rng((seed, 17))
    text = _text(random)
    face = _face(random, text)
    high = float(np.exp(random.uniform(np.log(34.0), np.log(110.0 if not scene else 70.0))))
    scale = 2 * high / (7 * CELL_PX)
    rows, columns = face.shape
    width, height = (round(n * scale * 1.06) for n in (columns, rows))
    if scene:
        width, height = max(1280, round(1.3 * width)), max(960, round(1.3 * height))
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], float)
    turned = float(random.normal(0.0, np.deg2rad(1.5)))
    turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    target: Array = (corners - corners.mean(axis=0)) * scale @ turn.T
    target = target * (1.0 + random.uniform(-0.02, 0.02, (4, 1))) + np.array([width, height]) / 2
    if scene:
        room = np.maximum(np.array([width, height]) / 2 - np.ptp(target, axis=0) / 2 - 20, 0)
        target = target + random.uniform(-0.9, 0.9, 2) * room
    matrix = homography(corners, target)
    around = surroundings(random, (height, width), "scene" if scene else "cropped", target)
    cover = cv2.warpPerspective(np.ones_like(face), matrix, (width, height), flags=cv2.INTER_AREA)
    seen = cv2.warpPerspective(face, matrix, (width, height), flags=cv2.INTER_AREA)
    picture = np.asarray(np.where(cover > 0.5, seen, around), np.float32)
    picture, _ = disturbed(random, picture, picture, 2 * high, 1, "scene", target)
    return DotCase(image=taken(random, picture, 0.5 * high, 1, "scene"), text=text, high_px=high)


def _text(random: np.random.Generator) -> str:
    digits = "".join(str(k) for k in random.integers(0, 10, int(random.integers(2, 6))))
    digits = digits.lstrip("0") or "0"
    if len(digits) > 2 and random.random() < 0.6:
        at = int(random.integers(1, len(digits)))
        digits = f"{digits[:at]}.{digits[at:]}"
    return "-" * (random.random() < 0.2) + digits if len(digits) > 1 else "4" + digits


def _face(random: np.random.Generator, text: str) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Return the lit and the unlit dots with some room around them, as gray levels."""
    is_dark = bool(random.random() < 0.4)
    ground, lit = (
        (random.uniform(110, 200), random.uniform(15, 70))
        if is_dark
        else (random.uniform(8, 45), random.uniform(150, 250))
    )
    ghost = ground + random.uniform(0.0, 0.12) * (lit - ground)
    is_round, size = bool(random.random() < 0.5), float(random.uniform(0.62, 0.92))
    form = int(random.integers(2))
    room, step = int(random.integers(2, 6)), 6
    rows, columns = 7 + 2 * room, step * len(text) - 1 + 2 * room
    face = np.full((rows * CELL_PX, columns * CELL_PX), ground, np.float32)
    for k, character in enumerate(text):
        ways = PATTERNS[character]
        for v, row in enumerate(ways[form % len(ways)].split()):
            for u, dot in enumerate(row):
                at = ((room + step * k + u) * CELL_PX + CELL_PX // 2, (room + v) * CELL_PX + CELL_PX // 2)
                half = round(0.5 * size * CELL_PX)
                gray = lit if dot == "1" else ghost
                if is_round:
                    cv2.circle(face, at, half, gray, -1, cv2.LINE_AA)
                else:
                    cv2.rectangle(face, (at[0] - half, at[1] - half), (at[0] + half, at[1] + half), gray, -1)
    return face
