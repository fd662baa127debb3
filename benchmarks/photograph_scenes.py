"""Draws ordinary pictures with one gauge somewhere in them, seen aslant, among pipes, flanges, bolts and words; or with none."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.vision_dials import CANVAS_PX, Colour, Rng
from benchmarks.vision_manometers import Way, behind_glass, on_canvas, taken
from hal.arrays import Array, Image

SIDES_PX = ((960, 720), (1280, 960), (1600, 1200), (720, 960))
WIDTH_SHARE = (0.1, 0.9)  # of the picture, which the gauge takes
LEAST_PX = 130.0  # width of a gauge
MOST_TILT_RAD = np.deg2rad(50.0)
FOCAL = 1.1  # over the picture's longer side
WORDS = ("PUMP 2", "P-101", "RETURN", "DANGER", "OPEN", "V12", "24 VDC", "SAMPLE")
MOUNT = 0.985  # of the canvas's half side: the disc that is cut out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """A picture, and of the gauge in it: reading, full scale, middle and width of its face (px), and tilt."""

    image: Image
    reading: float = 0.0
    full: float = 0.0
    middle_px: tuple[float, float] = (0.0, 0.0)
    width_px: float = 0.0
    tilt_rad: float = 0.0


def draw_scene(seed: int, way: Way) -> Scene:
    """Draw a gauge of random design somewhere in a picture, the same for the same seed."""
    rng = np.random.default_rng((seed, 11))
    pen, drawn = on_canvas(rng, way)
    picture = _surroundings(rng)
    height, width = picture.shape[:2]
    wide = float(
        np.exp(rng.uniform(np.log(max(WIDTH_SHARE[0] * width, LEAST_PX)), np.log(WIDTH_SHARE[1] * min(width, height))))
    )
    tilt, azimuth = float(rng.uniform(0.0, MOST_TILT_RAD)), float(rng.uniform(0.0, 2 * np.pi))
    room = 0.5 * wide * 1.05
    middle = np.array([rng.uniform(room, width - room), rng.uniform(room, height - room)])
    warp = _homography(middle, wide / (2 * pen.radius), tilt, azimuth, FOCAL * max(width, height))
    disc = np.zeros((CANVAS_PX, CANVAS_PX), np.float32)
    cv2.circle(disc, (CANVAS_PX // 2, CANVAS_PX // 2), round(MOUNT * CANVAS_PX / 2), 1.0, -1)
    if rng.random() < 0.3:  # on a square plate of its own
        disc[:] = 1.0
    reduced = 2 * pen.radius / wide
    face = behind_glass(pen, rng)
    if reduced > 1.0:
        face = np.asarray(cv2.GaussianBlur(face, (0, 0), 0.45 * reduced), np.uint8)
    seen = cv2.warpPerspective(face, warp, (width, height), flags=cv2.INTER_LINEAR).astype(np.float32)
    share = cv2.warpPerspective(disc, warp, (width, height))[..., None]
    at = warp @ np.array([*pen.middle, 1.0])
    return Scene(
        image=taken(np.asarray(picture * (1 - share) + seen * share, np.float32), 0.4 + 0.004 * wide, rng),
        reading=drawn.reading, full=drawn.full, middle_px=(float(at[0] / at[2]), float(at[1] / at[2])), width_px=wide,
        tilt_rad=tilt,
    )  # fmt: skip


def draw_without(seed: int) -> Image:
    """Draw a picture of plant without any instrument, the same for the same seed."""
    rng = np.random.default_rng((seed, 13))
    return taken(_surroundings(rng), 2.5, rng)


def _homography(middle: Array, scale: float, tilt: float, azimuth: float, focal_px: float) -> Array:
    """Return `picture_from_canvas` (3, 3) of a canvas about whose middle's axis in the direction `azimuth` it is tilted."""
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    turn = cv2.Rodrigues(axis * tilt)[0]
    # Canvas pixels from the middle, in picture pixels at the middle's distance, which is the focal length.
    plane = np.column_stack([turn[:, 0] * scale, turn[:, 1] * scale, [0.0, 0.0, focal_px]])
    camera = np.array([[focal_px, 0.0, middle[0]], [0.0, focal_px, middle[1]], [0.0, 0.0, 1.0]])
    from_middle = np.array([[1.0, 0.0, -CANVAS_PX / 2], [0.0, 1.0, -CANVAS_PX / 2], [0.0, 0.0, 1.0]])
    return np.asarray(camera @ plane @ from_middle)


def _surroundings(rng: Rng) -> NDArray[np.float32]:
    """Return plant: walls, pipes, flanges with bolts, handwheels, push buttons and words."""
    width, height = SIDES_PX[int(rng.integers(len(SIDES_PX)))]
    canvas = np.full((height, width, 3), rng.integers(30, 220, 3), np.uint8)
    for _ in range(int(rng.integers(4, 16))):
        at = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        size = float(rng.uniform(0.03, 0.3)) * width
        _thing(canvas, rng, at, size, _colour(rng))
    return canvas.astype(np.float32)


def _colour(rng: Rng) -> Colour:
    r, g, b = rng.integers(10, 245, 3).tolist()
    return r, g, b


def _thing(canvas: Image, rng: Rng, at: tuple[int, int], size: float, colour: Colour) -> None:
    """Draw a pipe, a box, a flange, a handwheel, a button or a word."""
    x, y = at
    match int(rng.integers(6)):
        case 0:
            end = (int(x + rng.normal(0, 3) * size), int(y + rng.normal(0, 3) * size))
            cv2.line(canvas, at, end, colour, max(6, round(0.3 * size)), cv2.LINE_AA)
            cv2.line(canvas, at, end, tuple(min(255, c + 40) for c in colour), max(2, round(0.08 * size)), cv2.LINE_AA)
        case 1:
            cv2.rectangle(
                canvas, at, (int(x + rng.uniform(0.3, 2) * size), int(y + rng.uniform(0.3, 2) * size)), colour, -1
            )
        case 2:
            cv2.circle(canvas, at, round(0.5 * size), colour, -1, cv2.LINE_AA)
            for turn in np.linspace(0, 2 * np.pi, 8, endpoint=False):
                bolt = (round(x + 0.4 * size * np.cos(turn)), round(y + 0.4 * size * np.sin(turn)))
                cv2.circle(canvas, bolt, max(2, round(0.06 * size)), _colour(rng), -1, cv2.LINE_AA)
        case 3:
            cv2.circle(canvas, at, round(0.5 * size), colour, max(3, round(0.08 * size)), cv2.LINE_AA)
            for turn in rng.uniform(0, np.pi) + np.linspace(0, 2 * np.pi, 5, endpoint=False):
                spoke = (round(x + 0.5 * size * np.cos(turn)), round(y + 0.5 * size * np.sin(turn)))
                cv2.line(canvas, at, spoke, colour, max(3, round(0.06 * size)), cv2.LINE_AA)
        case 4:
            cv2.circle(canvas, at, round(0.3 * size), (60, 60, 60), -1, cv2.LINE_AA)
            cv2.circle(canvas, at, round(0.22 * size), colour, -1, cv2.LINE_AA)
        case _:
            word = str(rng.choice(WORDS))
            cv2.putText(
                canvas, word, at, cv2.FONT_HERSHEY_SIMPLEX, max(0.5, size / 120), colour, max(1, round(size / 50)), cv2.LINE_AA
            )  # fmt: skip
