"""Faces of drawn seven-segment displays: segment shapes, slant, ghosts, bloom, and small words beside the digits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

Float32 = NDArray[np.float32]

HIGH_PX = 96  # height of a digit on the painted face
LIT = {
    "0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd", "6": "afgedc", "7": "abc",
    "8": "abcdefg", "9": "abcdfg", "-": "g", " ": "",
}  # fmt: skip
OTHER_FORMS = {"6": "cdefg", "7": "abcf", "9": "abcfg"}
WORDS = ("AUTO", "HOLD", "MAX", "SET", "kPa", "mA", "V", "Hz", "bar", "%", "LOW BAT", "REM")


@dataclass(frozen=True, slots=True, kw_only=True)
class Face:
    """Design of a display; lengths are in units of the digit height.

    `other_forms` are digits in their alternative form (6 and 9 without tail, 7 with one); `words` are small words in
    the window, each with its text, left end, baseline and letter height.
    """

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
    other_forms: str = ""
    words: tuple[tuple[str, float, float, float], ...] = ()


def random_face(random: np.random.Generator, *, is_dark: bool, thin: bool) -> Face:
    """Draw a random face with a number; with thin segments like panel displays, or else like commercial devices."""
    digits = int(random.integers(3, 7 if thin else 6))
    decimals = int(random.integers(0, min(4, digits)))
    least = 0 if not decimals else 10**decimals // 2
    number = int(random.integers(least, 10 ** int(random.integers(max(decimals + 1, 2), digits + 1))))
    text = f"{number:0{decimals + 1}d}"
    if len(text) < digits and random.random() < 0.25:
        text = "-" + text
    text = f"{text[:-decimals]}.{text[-decimals:]}" if decimals else text
    face = Face(
        text=text, digits=digits, decimals=decimals, is_dark=is_dark, cell=float(random.uniform(0.42, 0.60)),
        pitch=float(random.uniform(1.32, 1.75)), stroke=float(random.uniform(0.09, 0.13 if thin else 0.17)),
        slant=float(np.tan(np.deg2rad(random.choice([0.0, random.uniform(3, 11)])))), gap=float(random.uniform(0.01, 0.04)),
        shape=str(random.choice(["hexagon", "bar", "mitred"])),
        ghost=float(random.choice([0.0, random.uniform(0.02, 0.15)])), dot=float(random.uniform(0.055, 0.09)),
        room=(float(random.uniform(0.2, 0.7)), float(random.uniform(0.18, 0.4))),
    )  # fmt: skip
    return face if thin else _as_bought(random, face)


def _as_bought(random: np.random.Generator, face: Face) -> Face:
    """Return the face with features of commercial devices: rounded segments, alternative digits, small words."""
    other_forms = "".join(d for d in OTHER_FORMS if random.random() < 0.15)
    shape = "round" if random.random() < 0.2 else face.shape
    if random.random() < 0.6:
        return replace(face, other_forms=other_forms, shape=shape)
    size = float(random.uniform(0.15, 0.3))
    across = (face.digits - 1) * face.cell * face.pitch + face.cell
    if random.random() < 0.5:
        room = (face.room[0], face.room[1] + 1.4 * size)
        places = [
            (float(random.uniform(0.0, 0.7)) * across, -0.25 - 0.4 * size) for _ in range(int(random.integers(1, 3)))
        ]
    else:
        room = (max(face.room[0], 3.2 * size), face.room[1])
        places = [(across + 0.2, float(random.uniform(size, 1.0)))]
    words = tuple((str(random.choice(WORDS)), x + room[0], y + room[1], size) for x, y in places)
    return replace(face, other_forms=other_forms, shape=shape, room=room, words=words)


def face_ink(face: Face) -> tuple[Float32, Float32]:
    """Return (ink, ghosts) of a face, both (H, W) from 0 to 1: the lit segments, and the unlit ones."""
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
            if segment in (OTHER_FORMS if character in face.other_forms else LIT)[character]:
                cv2.fillPoly(ink, [np.round(points * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
    if face.decimals:
        k = face.digits - 1 - face.decimals
        x = face.room[0] + face.cell * (k * face.pitch + 1 + 0.5 * (face.pitch - 1)) - 0.5 * face.slant
        centre = (round(x * h * 16), round((face.room[1] + 1 - 0.5 * face.dot) * h * 16))
        cv2.circle(ink, centre, round(face.dot * h * 16), 1.0, -1, cv2.LINE_AA, 4)
    for word, x, foot, letter in face.words:
        scale, thickness = letter * h / 22.0, max(1, round(0.16 * letter * h))  # letters of scale 1 are 22 px high
        write(ink, word, (round(x * h), round(foot * h)), scale, 1.0, thickness)
    return ink, ghosts


def write(canvas: Float32, words: str, foot_px: tuple[int, int], scale: float, gray: float, thickness_px: int) -> None:
    """Write text into an (H, W) float image by way of a mask, because OpenCV 5 writes text into 8-bit images only."""
    stencil = np.zeros(canvas.shape, np.uint8)
    cv2.putText(stencil, words, foot_px, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness_px, cv2.LINE_8)
    canvas[stencil > 0] = gray


def _segment(face: Face, name: str) -> Array:
    """Return the (N, 2) outline of a segment, in digit heights from the upper left corner of the digit."""
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
        case "round":
            turns = np.linspace(-np.pi / 2, np.pi / 2, 7)[:, None]
            end = np.cos(turns) * along * t + np.sin(turns) * across
            points = np.vstack([b - t * along + end, a + t * along - end])
        case "mitred" if name != "g":
            inner = np.array([face.cell / 2, 0.25 if name in "bf" else 0.75 if name in "ce" else 0.5]) - (a + b) / 2
            s = np.sign(float(inner @ across)) * across
            points = np.array([a - s - t * along, b - s + t * along, b + s - t * along, a + s + t * along])
        case _:
            points = np.array([a, a + t * along + across, b - t * along + across, b, b - t * along - across,
                               a + t * along - across])  # fmt: skip
    return np.asarray(points + np.column_stack([face.slant * (0.5 - points[:, 1]), np.zeros(len(points))]))


def face_gray(random: np.random.Generator, face: Face, ink: Float32, ghosts: Float32, *, low: bool) -> Float32:
    """Return (H, W) gray levels of the face: bright with bloom, or dark with a cast shadow; `low`: at low contrast."""
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
