"""Draws overviews of unseen panels in the three levels of the data's README, to test what was taught on other images.

A panel of twelve objects (`panel_paint`) is projected into the image by a pinhole camera and degraded, in linear light,
by an illumination gradient, glare, shadow, cables, exposure, blur, motion, shot and read noise; then come a gamma of
2.2 and eight bits. Amounts follow the README: easy has up to 3 degrees of tilt and nothing in front; medium 12 degrees,
one glare and one shadow; hard 24 degrees, three glares, one shadow, two cables, exposure x0.35 to x1.5 and motion blur.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.display_face import LIT, Face, face_ink
from benchmarks.panel_paint import DARK, PX_PER_MM, WINDOW_FRAME_MM, Canvas, Truth, paint
from hal.arrays import Array, Image
from perception.vision.projection import homography

LEVELS = ("easy", "medium", "hard")
KINDS = ("gauge", "panel_meter", "display", "toggle", "rotary", "button", "lamp", "slider", "handwheel", "lever")
PANEL_MM = (400.0, 300.0)
SIZE_PX = (640, 480)
FOCAL_PX = 830.0
GAMMA = 2.2
GUESS_SIGMA_PX = 2.0
HIDDEN = 0.03  # share of what tells two numbers apart that is visible at most where cables hide it
LEAST_VISIBLE, MOST_SATURATED = 0.855, 0.25  # visible and saturated fractions of an object that counts as readable


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """Amounts of all degradations at one level; pairs are minimum and maximum."""

    tilt_rad: float
    slope: tuple[float, float]
    exposure: tuple[float, float]
    blur_px: tuple[float, float]
    motion_px: tuple[float, float]
    shot: float
    read: float
    glares: int
    shadows: int
    cables: int


AMOUNTS = {
    "easy": Level(tilt_rad=0.05, slope=(0.05, 0.15), exposure=(0.9, 1.05), blur_px=(0.3, 0.5), motion_px=(0.0, 0.0),
                  shot=0.004, read=0.002, glares=0, shadows=0, cables=0),
    "medium": Level(tilt_rad=0.21, slope=(0.12, 0.35), exposure=(0.68, 1.18), blur_px=(0.4, 0.9), motion_px=(0.0, 0.0),
                    shot=0.010, read=0.004, glares=1, shadows=1, cables=0),
    "hard": Level(tilt_rad=0.42, slope=(0.2, 0.62), exposure=(0.35, 1.5), blur_px=(0.6, 1.4), motion_px=(0.0, 4.0),
                  shot=0.022, read=0.008, glares=3, shadows=1, cables=2),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """Drawn overview: its image, its truth (as in a truth file) and the job of reading it as a taught panel."""

    image: Image
    truth: dict[str, Any]
    taught: dict[str, Any]


def draw_scene(seed: int, level: str) -> Scene:
    """Draw the overview of a seed at a level."""
    random = np.random.default_rng((seed, LEVELS.index(level)))
    amount = AMOUNTS[level]
    plate = float(random.uniform(110, 185))
    width, height = (round(mm * PX_PER_MM) for mm in PANEL_MM)
    canvas = Canvas(gray=np.full((height, width), plate, np.float32), plate=plate)
    for x, y in ((20.0, 15.0), (380.0, 15.0), (380.0, 285.0), (20.0, 285.0)):
        canvas.disc(x, y, 5.0, 60.0)
        canvas.disc(x, y, 4.0, 95.0)
    kinds = [*KINDS, *random.choice(KINDS, 2)]
    random.shuffle(kinds)
    objects = []
    for k, kind in enumerate(kinds):
        x, y = 50.0 + 100.0 * (k % 4) + random.uniform(-6, 6), 48.0 + 98.0 * (k // 4) + random.uniform(-4, 4)
        objects.append({**paint(canvas, random, str(kind), float(x), float(y)), "id": k, "label": ""})
    px_from_mm = _placed(random, amount.tilt_rad)
    image, cover, bright = _taken(random, canvas.gray, px_from_mm, amount)
    for panel_object in objects:
        panel_object.update(seen(panel_object, px_from_mm, cover, bright))
        if face := panel_object.pop("face", None):
            panel_object["undecidable"] = _is_undecidable(face, panel_object, px_from_mm, cover)
    truth = {"level": level, "kind": "overview", "panel_mm": list(PANEL_MM), "objects": objects}
    truth["H_mm_to_px"] = px_from_mm.tolist()
    return Scene(image=image, truth=truth, taught=_taught_job(random, truth))


def _placed(random: np.random.Generator, most_rad: float) -> Array:
    """Return the (3, 3) homography from panel millimetres to pixels of a camera that is tilted and rotated slightly."""
    lean, tilt = random.uniform(0, 2 * np.pi), most_rad * np.sqrt(random.uniform(0.1, 1.0))
    axis = np.array([np.cos(lean), np.sin(lean), 0.0])
    turn = (
        Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0, 0, random.normal(0, 0.35 * most_rad)])
    ).as_matrix()
    middle = np.array([*(np.array(PANEL_MM) / 2), 0.0])
    t = np.array([*random.normal(0, 8, 2), random.uniform(520, 570)]) - turn @ middle
    K = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2], [0, FOCAL_PX, SIZE_PX[1] / 2], [0, 0, 1]])
    return np.asarray(K @ np.column_stack([turn[:, :2], t]))


def _taken(
    random: np.random.Generator, panel: NDArray[np.float32], px_from_mm: Array, amount: Level
) -> tuple[Image, Array, NDArray[np.bool_]]:
    """Return the image, the fraction of every pixel that cables cover, and the mask of saturated pixels."""
    k = 2  # drawn at twice the final resolution
    size = (k * SIZE_PX[0], k * SIZE_PX[1])
    grow = np.diag([k, k, 1.0]) @ px_from_mm @ np.diag([1 / PX_PER_MM, 1 / PX_PER_MM, 1.0])
    scene = np.full(size[::-1], (float(random.uniform(DARK, 65)) / 255) ** GAMMA, np.float32)
    border = cv2.BORDER_TRANSPARENT  # the wall around the panel stays
    cv2.warpPerspective((panel / 255) ** GAMMA, grow, size, dst=scene, flags=cv2.INTER_LINEAR, borderMode=border)
    return pictured(random, scene.astype(float), amount, SIZE_PX)


def pictured(
    random: np.random.Generator, light: Array, amount: Level, size_px: tuple[int, int]
) -> tuple[Image, Array, NDArray[np.bool_]]:
    """Degrade an image of linear light by a level's light, cables, lens and noise.

    Returns:
        The image, the fraction of every pixel that cables cover, and the mask of saturated pixels.
    """
    light = _lit(random, light, amount)
    cover = _cables(random, (light.shape[1], light.shape[0]), amount.cables)
    light = light * (1 - cover) + float(random.uniform(0.01, 0.1)) * cover
    light = np.maximum(light, 0.0) * random.uniform(*amount.exposure)
    small, covered = (np.asarray(cv2.resize(x, size_px, interpolation=cv2.INTER_AREA), float) for x in (light, cover))
    blurred = np.asarray(cv2.GaussianBlur(small, (0, 0), random.uniform(*amount.blur_px)), float)
    small = _moved(random, blurred, random.uniform(*amount.motion_px))
    noise = np.sqrt(amount.shot**2 * np.maximum(small, 0) + amount.read**2)
    coded = np.clip(small + noise * random.normal(0, 1, small.shape), 0, 1) ** (1 / GAMMA)
    image = np.asarray(np.round(255 * coded), np.uint8)
    return image, covered, np.asarray(image >= 254)


def _lit(random: np.random.Generator, scene: Array, amount: Level) -> Array:
    """Return the (H, W) linear light of a scene with an illumination gradient, shadows and glare."""
    h, w = scene.shape
    v, u = np.mgrid[:h, :w] / w
    lean = random.uniform(0, 2 * np.pi)
    light = scene * (1 + random.uniform(*amount.slope) * 2 * (np.cos(lean) * (u - 0.5) + np.sin(lean) * (v - 0.375)))
    for _ in range(amount.shadows):
        middle = random.uniform(0.1, 0.9, 2) * (w, h)
        shade = np.zeros((h, w), np.float32)
        cv2.fillPoly(shade, [np.round(middle + random.uniform(-0.2, 0.2, (3, 2)) * w).astype(np.int32)], 1.0)
        light = light * (1 - random.uniform(0.3, 0.55) * cv2.GaussianBlur(shade, (0, 0), random.uniform(3, 12)))
    for _ in range(amount.glares):
        x, y, sigma = random.uniform(0.1, 0.9), random.uniform(0.1, 0.9) * h / w, random.uniform(0.02, 0.06)
        light = light + random.uniform(0.4, 1.6) * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    return np.asarray(light)


def _cables(random: np.random.Generator, size: tuple[int, int], count: int) -> Array:
    """Return the (H, W) fraction of every pixel that is behind cables, which run from top to bottom with one bend."""
    w, h = size
    cover = np.zeros((h, w), np.float32)
    for _ in range(count):
        x0 = random.uniform(0.05, 0.95)
        x1 = x0 + random.uniform(-0.12, 0.12)
        line = np.array([[x0 * w, 0], [x1 * w, 0.5 * h], [(x1 + random.uniform(-0.2, 0.2)) * w, h]])
        thick = round(random.uniform(0.008, 0.02) * w)
        cv2.polylines(cover, [np.round(line * 16).astype(np.int32)], False, 1.0, thick, cv2.LINE_AA, 4)
    return np.asarray(cover, float)


def _moved(random: np.random.Generator, image: Array, length_px: float) -> Array:
    """Return the image with motion blur in a random direction."""
    if length_px < 0.3:
        return image
    a, steps = random.uniform(0, np.pi), 9
    out = np.zeros_like(image)
    for s in np.linspace(-0.5, 0.5, steps):
        shift = np.array([[1, 0, s * length_px * np.cos(a)], [0, 1, s * length_px * np.sin(a)]])
        out += cv2.warpAffine(image, shift, image.shape[::-1], borderMode=cv2.BORDER_REPLICATE) / steps
    return out


def seen(panel_object: Truth, px_from_mm: Array, cover: Array, bright: NDArray[np.bool_]) -> Truth:
    """Return where an object is in the image and how much of it is visible."""
    (x, y), (w, h) = panel_object["center_mm"], (s / 2 for s in panel_object["size"])
    quad = _applied(px_from_mm, np.array([[x - w, y - h], [x + w, y - h], [x + w, y + h], [x - w, y + h]]))
    margin = 400
    mask = np.zeros((cover.shape[0] + 2 * margin, cover.shape[1] + 2 * margin), np.uint8)
    cv2.fillPoly(mask, [np.round(quad + margin).astype(np.int32)], 1)
    inside = mask[margin:-margin, margin:-margin] > 0
    total = max(int(mask.sum()), 1)
    visible = float((1.0 - cover)[inside].sum()) / total
    saturated = float(bright[inside].sum()) / total
    low = quad.min(axis=0)
    is_lit = panel_object["cls"] in ("lamp", "button")
    return {
        "center_px": _applied(px_from_mm, np.array([[x, y]]))[0].tolist(), "quad_px": quad.tolist(),
        "bbox_px": [*low.tolist(), *(quad.max(axis=0) - low).tolist()], "visible": visible, "saturated": saturated,
        "readable": visible >= LEAST_VISIBLE and (is_lit or saturated <= MOST_SATURATED),
    }  # fmt: skip


def _is_undecidable(face: Face, panel_object: Truth, px_from_mm: Array, cover: Array) -> bool:
    """Return whether cables hide every difference between the number of a display and another one."""
    ink, _ = face_ink(face)
    (x, y), (w, h) = panel_object["center_mm"], (side - WINDOW_FRAME_MM for side in panel_object["size"])
    mm_from_face = np.array([[w / ink.shape[1], 0, x - w / 2], [0, h / ink.shape[0], y - h / 2], [0, 0, 1]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    clear = cv2.warpPerspective(1.0 - cover, px_from_mm @ mm_from_face, ink.shape[::-1], flags=flags)
    differences = (np.abs(ink - face_ink(rival)[0]) for rival in _rivals(face))
    return any(float((off * clear).sum()) <= HIDDEN * float(off.sum()) for off in differences)


def _rivals(face: Face) -> Iterator[Face]:
    """Yield the faces whose number differs in one character, or has no decimal point."""
    for k, character in enumerate(face.text):
        if character in LIT:
            yield from (replace(face, text=face.text[:k] + c + face.text[k + 1 :]) for c in LIT if c != character)
    if face.decimals:
        yield replace(face, decimals=0)


def _taught_job(random: np.random.Generator, truth: dict[str, Any]) -> dict[str, Any]:
    """Return the input of a reader of the taught panel: the layout, and the panel's position to about two pixels."""
    width, height = truth["panel_mm"]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    px = _applied(np.array(truth["H_mm_to_px"]), corners) + random.normal(0, GUESS_SIGMA_PX, (4, 2))
    guess = homography(corners, px)
    hidden = (
        "reading",
        "state",
        "text",
        "undecidable",
        "visible",
        "saturated",
        "readable",
        "quad_px",
        "bbox_px",
        "center_px",
    )
    layout = []
    for panel_object in truth["objects"]:
        entry = {key: value for key, value in panel_object.items() if key not in hidden}
        if panel_object["cls"] == "display":
            entry = {key: value for key, value in entry.items() if key not in ("min", "max")}
        elif panel_object["cls"] == "rotary":
            n = panel_object["positions"]
            span = {2: 90, 3: 120, 4: 150, 5: 180}[n]
            entry["state_angles_deg"] = {str(k): -span / 2 + span * k / (n - 1) for k in range(n)}
        elif panel_object["cls"] == "slider":
            entry["travel_mm"] = max(panel_object["size"]) - 16
        layout.append(entry)
    return {"id": "drawn", "mode": "taught", "panel_mm": truth["panel_mm"], "H_guess": guess.tolist(), "layout": layout}


def _applied(matrix: Array, points: Array) -> Array:
    out = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return np.asarray(out[:, :2] / out[:, 2:])
