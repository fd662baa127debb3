"""Draws seven-segment displays as cameras see them: own renderings, for tests and a line of the benchmark.

A face (segment shapes, ghosts, bloom, window, bezel) is painted upright and large, laid into the picture by a homography, and
then meets light, glare, cables, lens, sensor and JPEG. Nothing in it is taken from the development images.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.view import Array, homography

Float32 = NDArray[np.float32]
Gray = NDArray[np.uint8]

HIGH_PX = 96  # of a digit on the painted face
LIT = {
    "0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd", "6": "afgedc", "7": "abc",
    "8": "abcdefg", "9": "abcdfg", "-": "g", " ": "",
}  # fmt: skip
LEVELS = ("easy", "medium", "hard")
PHOTOGRAPHS = ("cropped", "scene", "low contrast")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisplayCase:
    """One drawn display and what it says.

    Attributes:
        image: (H, W) uint8.
        text: what it shows, leading blanks left out.
        corners_px: (4, 2) outer corners of the window (inside the bezel), clockwise from the upper left.
        size: width and height of the window over the digit height.
        is_dark: dark segments on a bright ground (LCD).
        digits, decimals: cells of the display and places behind its point.
        hidden: share of the lit segments' ink that a cable covers.
    """

    image: Gray
    text: str
    corners_px: Array
    size: tuple[float, float]
    is_dark: bool
    digits: int
    decimals: int
    hidden: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Face:
    """How a display is built; lengths over the digit height."""

    text: str
    digits: int
    decimals: int
    is_dark: bool
    cell: float
    pitch: float
    stroke: float
    slant: float
    gap: float
    shape: str
    ghost: float
    dot: float
    room: tuple[float, float]


def draw_taught(seed: int, level: str) -> DisplayCase:
    """A display on a plate as the taught panel sees it: 1.2 to 3 px of image a stroke, disturbed by level."""
    random = np.random.default_rng((seed, LEVELS.index(level)))
    face = _face(random, is_dark=bool(random.random() < 0.4), thin=True)
    hard = LEVELS.index(level)
    high = float(random.uniform(19, 34) if hard < 2 else random.uniform(17, 30))
    return _pictured(random, face, high, tilt=(0.03, 0.12, 0.28)[hard], hard=hard, span=(150, 250))


def draw_photograph(seed: int, kind: str) -> DisplayCase:
    """A photograph of an LCD or LED device: cropped to its display, with the device round it, or of very low contrast."""
    random = np.random.default_rng((seed, 7 + PHOTOGRAPHS.index(kind)))
    face = _face(random, is_dark=bool(random.random() < 0.75), thin=False)
    high = float(np.exp(random.uniform(np.log(28), np.log(110))))
    if kind == "scene":
        return _pictured(random, face, min(high, 70.0), tilt=0.15, hard=1, span=(640, 480), photo=kind)
    return _pictured(random, face, high, tilt=0.08, hard=1, span=(0, 0), photo=kind)


def _face(random: np.random.Generator, *, is_dark: bool, thin: bool) -> Face:
    digits = int(random.integers(3, 7 if thin else 6))
    decimals = int(random.integers(0, min(4, digits)))
    least = 0 if not decimals else 10**decimals // 2
    number = int(random.integers(least, 10 ** int(random.integers(max(decimals + 1, 2), digits + 1))))
    text = f"{number:0{decimals + 1}d}"
    if len(text) < digits and random.random() < 0.25:
        text = "-" + text
    text = f"{text[:-decimals]}.{text[-decimals:]}" if decimals else text
    return Face(
        text=text, digits=digits, decimals=decimals, is_dark=is_dark, cell=float(random.uniform(0.42, 0.60)),
        pitch=float(random.uniform(1.32, 1.75)), stroke=float(random.uniform(0.09, 0.13 if thin else 0.17)),
        slant=float(np.tan(np.deg2rad(random.choice([0.0, random.uniform(3, 11)])))), gap=float(random.uniform(0.01, 0.04)),
        shape=str(random.choice(["hexagon", "bar", "mitred"])),
        ghost=float(random.choice([0.0, random.uniform(0.02, 0.15)])), dot=float(random.uniform(0.055, 0.09)),
        room=(float(random.uniform(0.2, 0.7)), float(random.uniform(0.18, 0.4))),
    )  # fmt: skip


def face_ink(face: Face) -> tuple[Float32, Float32]:
    """(ink, ghosts) of a face, both (H, W) from 0 to 1: what is lit, and where every unlit segment is."""
    h = HIGH_PX
    width = (face.digits - 1) * face.cell * face.pitch + face.cell + 2 * face.room[0]
    size = (round((1 + 2 * face.room[1]) * h), round(width * h))
    ink, ghosts = np.zeros(size, np.float32), np.zeros(size, np.float32)
    characters = face.text.replace(".", "").rjust(face.digits)
    for k, character in enumerate(characters):
        for segment in "abcdefg":
            points = _segment(face, segment)
            points = (points + np.array([face.room[0] + k * face.cell * face.pitch, face.room[1]])) * h
            cv2.fillPoly(ghosts, [np.round(points * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
            if segment in LIT[character]:
                cv2.fillPoly(ink, [np.round(points * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
    if face.decimals:
        k = face.digits - 1 - face.decimals
        x = face.room[0] + face.cell * (k * face.pitch + 1 + 0.5 * (face.pitch - 1)) - 0.5 * face.slant
        centre = (round(x * h * 16), round((face.room[1] + 1 - 0.5 * face.dot) * h * 16))
        cv2.circle(ink, centre, round(face.dot * h * 16), 1.0, -1, cv2.LINE_AA, 4)
    return ink, ghosts


def _segment(face: Face, name: str) -> Array:
    """(N, 2) outline of a segment in digit heights, from the cell's upper left corner."""
    t = face.stroke / 2
    x0, x1, y0, ym, y1 = t, face.cell - t, t, 0.5, 1 - t
    (ax, ay), (bx, by) = {
        "a": ((x0, y0), (x1, y0)), "b": ((x1, y0), (x1, ym)), "c": ((x1, ym), (x1, y1)), "d": ((x0, y1), (x1, y1)),
        "e": ((x0, ym), (x0, y1)), "f": ((x0, y0), (x0, ym)), "g": ((x0, ym), (x1, ym)),
    }[name]  # fmt: skip
    a, b = np.array([ax, ay]), np.array([bx, by])
    along = (b - a) / np.linalg.norm(b - a)
    across = np.array([-along[1], along[0]]) * t
    a, b = a + along * face.gap, b - along * face.gap
    match face.shape:
        case "bar":
            a, b = a + 0.8 * t * along, b - 0.8 * t * along
            points = np.array([a + across, b + across, b - across, a - across])
        case "mitred" if name != "g":
            inner = np.array([face.cell / 2, 0.25 if name in "bf" else 0.75 if name in "ce" else 0.5]) - (a + b) / 2
            s = np.sign(float(inner @ across)) * across
            points = np.array([a - s - t * along, b - s + t * along, b + s - t * along, a + s + t * along])
        case _:
            points = np.array([a, a + t * along + across, b - t * along + across, b, b - t * along - across,
                               a + t * along - across])  # fmt: skip
    return np.asarray(points + np.column_stack([face.slant * (0.5 - points[:, 1]), np.zeros(len(points))]))


def _pictured(
    random: np.random.Generator, face: Face, high: float, *, tilt: float, hard: int, span: tuple[int, int], photo: str = ""
) -> DisplayCase:  # fmt: skip
    """The face in a picture: `high` px a digit, `span` rows of plate round it (0: cropped)."""
    k = 2  # the picture is made twice as large as it is taken
    ink, ghosts = face_ink(face)
    shading = _face_gray(random, face, ink, ghosts, low=photo == "low contrast")
    bezel = round((0.08 if not photo else random.uniform(0.03, 0.3)) * HIGH_PX)
    scale = k * high / HIGH_PX
    rows, columns = ink.shape
    framed = cv2.copyMakeBorder(
        shading, bezel, bezel, bezel, bezel, cv2.BORDER_CONSTANT,
        value=float(random.uniform(20, 70) if not photo or random.random() < 0.6 else random.uniform(90, 190)))  # fmt: skip
    crop = round(random.uniform(-0.3 * bezel, 1.2 * bezel)) if photo and photo != "scene" else 0
    height, width = (round(n * scale + 2 * (crop * scale if photo and photo != "scene" else 0.35 * high * k + 20))
                     for n in (rows, columns))  # fmt: skip
    if photo == "scene":
        width, height = (k * max(n, round(m / k * 1.15)) for n, m in zip(span, (width, height), strict=True))
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], float)
    target = (corners - corners.mean(axis=0)) * scale
    target = _tilted(random, target, tilt * (0.35 if photo else 1.0)) + np.array([width / 2, height / 2])
    if photo == "scene":
        room = np.maximum(np.array([width, height]) / 2 - np.ptp(target, axis=0) / 2 - 20, 0)
        target = target + random.uniform(-0.9, 0.9, 2) * room
    matrix = homography(corners + bezel, target)
    picture = _surroundings(random, (height, width), photo, target)
    cover = cv2.warpPerspective(np.ones_like(framed), matrix, (width, height), flags=cv2.INTER_AREA)
    face_px = cv2.warpPerspective(framed, matrix, (width, height), flags=cv2.INTER_AREA)
    picture = np.asarray(np.where(cover > 0.5, face_px, picture), np.float32)
    lit = np.asarray(
        cv2.warpPerspective(ink, homography(corners, target), (width, height), flags=cv2.INTER_AREA), np.float32
    )
    picture, hidden = _disturbed(random, picture, lit, high * k, hard, photo, target)
    image = _taken(random, picture, high, hard, photo)
    return DisplayCase(
        image=image, text=face.text, corners_px=target / k, is_dark=face.is_dark, digits=face.digits,
        size=(columns / HIGH_PX, rows / HIGH_PX), decimals=face.decimals, hidden=hidden,
    )  # fmt: skip


def _face_gray(random: np.random.Generator, face: Face, ink: Float32, ghosts: Float32, *, low: bool) -> Float32:
    if not face.is_dark:
        back, light = random.uniform(8, 40), random.uniform(110, 230)
        if low:
            back, light = random.uniform(60, 110), random.uniform(14, 40)
        bloom = cv2.GaussianBlur(ink, (0, 0), random.uniform(0.08, 0.25) * HIGH_PX)
        shade = np.maximum(ink, face.ghost * ghosts) + random.uniform(0.0, 0.35) * bloom
        return np.asarray(back + light * shade, np.float32)
    back, depth = random.uniform(105, 185), random.uniform(0.45, 0.85)
    if low:
        depth = random.uniform(0.08, 0.2)
    step = random.uniform(0.0, 0.05, 2) * HIGH_PX
    shadow = cv2.warpAffine(ink, np.array([[1, 0, step[0]], [0, 1, step[1]]]), ink.shape[::-1])
    shadow = cv2.GaussianBlur(shadow, (0, 0), 0.02 * HIGH_PX) * random.uniform(0.0, 0.35)
    shade = np.maximum(np.maximum(ink, shadow), face.ghost * ghosts)
    return np.asarray(back * (1.0 - depth * shade), np.float32)


def _tilted(random: np.random.Generator, points: Array, tilt: float) -> Array:
    """Points seen from aside: foreshortened and converging, and turned a little."""
    turn = random.normal(0.0, 0.35 * tilt)
    lean = random.uniform(0, 2 * np.pi)
    n = np.array([np.cos(lean), np.sin(lean)])
    reach = float(np.abs(points).max())
    depth = 1.0 + 0.5 * np.sin(tilt * 1.5) * (points @ n) / reach
    squeezed = points - (1 - np.cos(tilt * 1.5)) * np.outer(points @ n, n)
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray((squeezed / depth[:, None]) @ np.array([[c, s], [-s, c]]))


def _surroundings(random: np.random.Generator, shape: tuple[int, int], photo: str, target: Array) -> Float32:
    """Plate or device round the display: a flat gray, in scenes with a case, keys and words."""
    picture = np.full(shape, random.uniform(60, 200), np.float32)
    if photo != "scene":
        return picture
    middle, half = target.mean(axis=0), np.ptp(target, axis=0) / 2
    gray = float(random.uniform(30, 220))
    for sign, grow in ((-1, random.uniform(1.2, 1.8)), (1, random.uniform(1.2, 2.4))):
        low = np.round(middle - grow * half - 12).astype(int)
        high = np.round(middle + (grow, grow * random.uniform(1.0, 2.0)) * half + 12).astype(int)
        cv2.rectangle(picture, low.tolist(), high.tolist(), gray + sign * 12.0, -1)
        break
    for _ in range(int(random.integers(3, 12))):
        x, y = random.uniform(0, shape[1]), random.uniform(0, shape[0])
        word = "".join(random.choice(list("AMPVOLTSETMODE0123")) for _ in range(random.integers(2, 7)))
        cv2.putText(
            picture, word, (int(x), int(y)), 0, float(random.uniform(0.5, 1.6)), gray * 0.4 + 20.0, 2, cv2.LINE_AA
        )
        x, y = random.uniform(0, shape[1]), random.uniform(0, shape[0])
        w, h = random.uniform(20, 120, 2)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), float(random.uniform(20, 230)), -1)
    return picture


def _disturbed(
    random: np.random.Generator, picture: Float32, lit: Float32, high: float, hard: int, photo: str, target: Array
) -> tuple[Float32, float]:  # fmt: skip
    """Uneven light, glare and cables; and the share of the lit ink that these cables cover."""
    height, width = picture.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    lean, ratio = random.uniform(0, 2 * np.pi), (1.2, 1.7, 2.4)[hard]
    along = (np.cos(lean) * (u - width / 2) + np.sin(lean) * (v - height / 2)) / (max(width, height) / 2)
    out = picture * np.exp(0.5 * np.log(random.uniform(1.0, ratio)) * along)
    middle, half = target.mean(axis=0), np.ptp(target, axis=0) / 2
    strength = (0.0, 70.0, 190.0)[hard] * (0.6 if photo else 1.0)
    if hard and random.random() < 0.7:
        x, y = middle + random.uniform(-1.3, 1.3, 2) * half
        r = random.uniform(0.5, 1.6) * high
        out = out + random.uniform(0.3, 1.0) * strength * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * r * r))
    if photo and random.random() < 0.3:  # a window mirrored in the glass: straight, sharp edges
        x, y = middle + random.uniform(-1.0, 1.0, 2) * half
        side = random.uniform(0.4, 1.5, 2) * high
        quad = np.array([[x, y], [x + side[0], y + 3], [x + side[0] + 5, y + side[1]], [x + 4, y + side[1]]])
        mirror = np.zeros_like(out)
        cv2.fillPoly(mirror, [np.round(quad).astype(np.int32)], float(random.uniform(5, 25)), cv2.LINE_AA)
        out = out + cv2.GaussianBlur(mirror, (0, 0), 1.5)
    if hard < 2 or random.random() < 0.55:
        return np.asarray(out, np.float32), 0.0
    mask = np.zeros_like(out)
    x0, x1 = (float(random.uniform(-0.1, 1.1)) * width for _ in range(2))
    x1 = x0 + np.clip(x1 - x0, -0.5 * height, 0.5 * height)
    bend = (0.5 * (x0 + x1) + float(random.normal(0, 0.04 * height)), float(random.uniform(0.0, 1.0)) * height)
    thick = max(2, round(float(random.uniform(0.12, 0.38)) * high))
    line = np.array([[x0, -9], bend, [x1, height + 9]])
    cv2.polylines(mask, [np.round(line * 16).astype(np.int32)], False, 1.0, thick, cv2.LINE_AA, 4)
    gray = float(random.uniform(15, 120))
    out = out * (1 - mask) + gray * mask * (0.85 + 0.3 * cv2.GaussianBlur(mask, (0, 0), thick / 3))
    return np.asarray(out, np.float32), float((lit * mask).sum() / max(float(lit.sum()), 1e-6))


def _taken(random: np.random.Generator, picture: Float32, high: float, hard: int, photo: str) -> Gray:
    """The picture through exposure, lens, sensor and file."""
    exposure = random.uniform(*((0.9, 1.1), (0.7, 1.25), (0.4, 1.4))[hard])
    stroke = 0.11 * high
    blur = random.uniform(0.3, (0.3, 0.45, 0.5)[hard] * stroke + 0.35)
    small = cv2.resize(picture * exposure, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)
    if random.random() < 0.5:
        radius = max(1, round(1.6 * blur))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.float32)
        small = cv2.filter2D(small, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    else:
        small = cv2.GaussianBlur(small, (0, 0), blur)
    noise = random.uniform(0.5, (1.5, 3.0, 6.0)[hard])
    small = small + random.normal(0.0, 1.0, small.shape) * noise * np.sqrt(0.3 + np.maximum(small, 0) / 180)
    image = np.asarray(np.clip(np.round(small), 0, 255), np.uint8)
    if not photo:
        return image
    quality = int(random.integers(55, 96))
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0), np.uint8)
