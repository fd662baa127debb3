"""Draws photographs of pressure gauges with known readings: double scales, bands, screws, words, shadows, reflections.

By default the scale spans three quarters of a turn; the pointer is dark or red with a counterweight, and there is a
bezel with something around it. The search for the pointer was not tuned on them; the search for the ends of ticks was
tested on seeds 70000 to 70320, 71000 to 71099 and 84000 to 84199.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.printed_text import Print, print_number, print_unit
from benchmarks.vision_dials import CANVAS_PX, SPAN_RAD, Colour, DrawnDial, Pen, Rng, seen_aslant
from hal.arrays import Image

SMALLEST_PX, LARGEST_PX = 110.0, 600.0
FULL_SCALES = (1, 2.5, 4, 6, 10, 16, 25, 60, 100, 160, 200, 300)
INKS = ((25, 25, 30), (25, 25, 30), (180, 40, 45), (40, 60, 150))
POINTERS = ((20, 20, 25), (20, 20, 25), (20, 20, 25), (175, 30, 35))
CAPS = ((30, 30, 30), (150, 150, 155), (190, 165, 90))
WORDS = ("bar", "psi", "kPa", "kg/cm2", "MPa", "PRESSURE", "CL 1.6", "EN 837-1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """Sweep of a pointer: its angle, the clockwise rotation of the whole gauge, whether the numerals run
    counter-clockwise, and whether a red pointer for the maximum, or for a set value, stands beside the black one.
    Without a print the numerals are small. A `unit` is printed above or below the middle, as large as the numerals.
    """

    print: Print | None = None
    span_rad: float = SPAN_RAD
    turned_rad: float = 0.0
    falls: bool = False
    has_red: bool = False
    unit: str = ""

    def angle_rad(self, share: float) -> float:
        """Return the angle of a fraction of the scale, clockwise from up."""
        return ((0.5 - share) if self.falls else (share - 0.5)) * self.span_rad + self.turned_rad


USUAL = Way()
UNUSUAL = {
    "90 deg": Way(span_rad=np.deg2rad(90.0)),
    "180 deg": Way(span_rad=np.deg2rad(180.0)),
    "240 deg": Way(span_rad=np.deg2rad(240.0)),
    "300 deg": Way(span_rad=np.deg2rad(300.0)),
    "turned by 6 deg": Way(turned_rad=np.deg2rad(6.0)),
    "turned by 12 deg": Way(turned_rad=np.deg2rad(-12.0)),
}
LEAST_APART = 0.06  # of the scale: two pointers of one gauge that are nearer hide each other


def draw_manometer(seed: int, way: Way = USUAL, share: float | None = None) -> DrawnDial:
    """Draw a pressure gauge of random design with a reading from 0 to 10, the same for the same seed.

    Args:
        share: of the scale, at which the pointer stands; None: by the seed, which decides all the rest in any case.
    """
    rng = np.random.default_rng(seed)
    pen, drawn = on_canvas(rng, way, share)
    return replace(drawn, image=_photographed(pen, rng))


def on_canvas(rng: Rng, way: Way, at: float | None = None) -> tuple[Pen, DrawnDial]:
    """Draw a pressure gauge, and return the pen that drew it and the drawing as it is on the canvas."""
    by_seed = float(rng.uniform(0.0, 0.98))
    share = by_seed if at is None else at
    angle = way.angle_rad(share)
    pen = _mounted(rng)
    level = int(rng.integers(215, 250))
    pen.disc(0.0, (0.0, 0.0), 1.0, (level, level, level - int(rng.integers(0, 15))))
    full = _face(pen, rng, way)
    if way.print is not None and way.unit:
        print_unit(pen, way.print, way.unit, INKS[0])
    red = _second_share(rng, share) if way.has_red else None
    if red is not None:
        _red_pointer(pen, rng, way.angle_rad(red))
    shape = _shadow_and_pointer(pen, rng, angle, POINTERS[0] if way.has_red else None)
    return pen, DrawnDial(
        image=pen.canvas, reading=10 * share, circular=False, shape=shape, red=None if red is None else 10 * red, full=full
    )  # fmt: skip


def _second_share(rng: Rng, first: float) -> float:
    """Return a share of the scale that is not too near to the first pointer's."""
    while abs((share := float(rng.uniform(0.0, 1.0))) - first) < LEAST_APART:
        pass
    return share


def _red_pointer(pen: Pen, rng: Rng, angle: float) -> None:
    """Draw the pointer of a maximum or of a set value: red, thin, with or without a tail, below the black one."""
    reach, half = float(rng.uniform(0.6, 0.92)), float(rng.uniform(0.008, 0.022))
    tail = float(rng.uniform(0.0, 0.3))
    colour = (int(rng.integers(150, 230)), int(rng.integers(15, 60)), int(rng.integers(15, 60)))
    pen.fill(angle, [(reach, half), (-tail, half), (-tail, -half), (reach, -half)], colour)


def _mounted(rng: Rng) -> Pen:
    """Draw a bezel in front of pipes and plates, and return the pen for the face."""
    canvas = np.full((CANVAS_PX, CANVAS_PX, 3), rng.integers(20, 230, 3), np.uint8)
    for _ in range(int(rng.integers(0, 7))):
        a, b = rng.integers(-100, CANVAS_PX + 100, (2, 2))
        colour = tuple(int(c) for c in rng.integers(10, 245, 3))
        if rng.random() < 0.5:
            cv2.rectangle(canvas, tuple(map(int, a)), tuple(map(int, b)), colour, -1)
        else:
            cv2.line(canvas, tuple(map(int, a)), tuple(map(int, b)), colour, int(rng.integers(8, 90)), cv2.LINE_AA)
    middle = CANVAS_PX / 2 + rng.normal(0.0, 0.015 * CANVAS_PX, 2)
    outer = float(rng.uniform(0.36, 0.48)) * CANVAS_PX
    pen = Pen(canvas=canvas, middle=middle, radius=outer * float(rng.uniform(0.82, 0.95)))
    dark, light = sorted(int(v) for v in rng.integers(20, 215, 2))
    for k in range(12):  # a turned metal ring, whose gray changes inwards
        gray = round(dark + (light - dark) * abs(np.sin(k / 11 * np.pi)))
        pen.disc(0.0, (0.0, 0.0), (outer + (pen.radius - outer) * k / 12) / pen.radius, (gray, gray, gray))
    return pen


def _face(pen: Pen, rng: Rng, way: Way) -> float:
    """Draw scales, words and screws; returns the largest value of the outer scale."""
    full, steps = float(rng.choice(FULL_SCALES)), int(rng.choice((4, 5, 6, 8, 10)))
    outer = float(rng.uniform(0.88, 0.96))
    ink = INKS[int(rng.integers(len(INKS)))]
    if rng.random() < 0.5:
        first = float(rng.uniform(0.5, 0.9))
        band = (200, 40, 45) if rng.random() < 0.7 else (60, 150, 60)
        band_at = float(rng.uniform(0.70, 0.95)) if way.print is None else outer + float(rng.uniform(-0.05, 0.0))
        _arc(pen, way, band_at, (first, 1.0), band, float(rng.uniform(0.02, 0.06)))
    _ring(pen, rng, way, full, steps, outer, ink)
    if rng.random() < 0.5:
        second = INKS[int(rng.integers(len(INKS)))]
        _ring(pen, rng, way, round(full * 14.5), steps, float(rng.uniform(0.50, 0.62)), second)
    for _ in range(int(rng.integers(0, 4))):
        word = str(rng.choice(WORDS))
        _write(
            pen,
            word,
            (float(rng.uniform(-0.6, 0.45)), float(rng.normal(0, 0.05))),
            float(rng.uniform(0.0010, 0.0018)),
            ink,
        )
    if rng.random() < 0.4:
        for side in (-1, 1):
            at = (-float(rng.uniform(0.45, 0.55)), 0.14 * side)
            pen.disc(0.0, at, 0.05, (110, 110, 110))
            pen.disc(0.0, at, 0.035, (190, 190, 195))
            left, right = (pen.place(0, (at[0] + off, at[1])) for off in (-0.03, 0.03))
            cv2.line(pen.canvas, left, right, (70, 70, 70), 3, cv2.LINE_AA, 4)
    return full


def _ring(pen: Pen, rng: Rng, way: Way, full: float, steps: int, outer: float, ink: Colour) -> None:
    """Draw a scale of ticks that end at the radius `outer`, with numerals inside."""
    minor, size = int(rng.choice((2, 4, 5, 10))), float(rng.uniform(0.0014, 0.0024))
    step = full / steps if way.print is None else _usual_step(full, steps)
    for k in range(int(full / step * minor + 1e-9) + 1):
        value = k * step / minor
        turn = way.angle_rad(value / full)
        long, half = (0.09, 0.009) if k % minor == 0 else (0.05, 0.004)
        pen.fill(turn, [(outer - long, -half), (outer - long, half), (outer, half), (outer, -half)], ink)
        if k % minor:
            continue
        if way.print is not None:
            print_number(pen, way.print, f"{value:g}", turn, outer, ink)
            continue
        at = (outer - 0.19) * np.array([np.cos(turn), np.sin(turn)])
        _write(pen, f"{value:g}", (float(at[0]), float(at[1])), size, ink)
    if rng.random() < 0.5:
        _arc(pen, way, outer, (0.0, 1.0), ink, 0.008)


def _usual_step(full: float, wanted: int) -> float:
    """Return the step of a usual scale whose number of steps is nearest to the wanted one, with all of its numbers told."""
    steps = [mantissa * 10.0**power for power in range(-2, 4) for mantissa in (1.0, 2.0, 2.5, 5.0)]
    return min((step for step in steps if 3.9 < full / step < 12.0), key=lambda step: abs(full / step - wanted))


def _arc(pen: Pen, way: Way, at: float, shares: tuple[float, float], colour: Colour, width: float) -> None:
    turn = np.array([way.angle_rad(share) for share in np.linspace(*shares, 60)])
    rim = [(r * np.cos(t), r * np.sin(t)) for r, ts in ((at, turn), (at - width, turn[::-1])) for t in ts]
    pen.fill(0.0, [(float(u), float(v)) for u, v in rim], colour)


def _write(pen: Pen, text: str, at: tuple[float, float], size: float, ink: Colour) -> None:
    x, y = pen.place(0.0, at)
    scale, thick = size * pen.radius, max(1, round(2.5 * size * pen.radius))
    (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    where = (x // 16 - w // 2, y // 16 + h // 2)
    cv2.putText(pen.canvas, text, where, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, thick, cv2.LINE_AA)


def _shadow_and_pointer(pen: Pen, rng: Rng, angle: float, fixed: Colour | None = None) -> str:
    shape = str(rng.choice(("spade", "bar", "moon", "plain")))
    reach, tail = float(rng.uniform(0.70, 0.92)), float(rng.uniform(0.22, 0.42))
    half = float(rng.uniform(0.012, 0.035))
    colour = POINTERS[int(rng.integers(len(POINTERS)))] if fixed is None else fixed
    cap = CAPS[int(rng.integers(len(CAPS)))]
    hub = float(rng.uniform(0.05, 0.13))
    if rng.random() < 0.5:
        shade = np.zeros_like(pen.canvas)
        off = rng.normal(0.0, 0.035, 2) * pen.radius
        ghost = Pen(canvas=shade, middle=pen.middle + off, radius=pen.radius)
        _one_pointer(ghost, shape, angle, reach, tail, half, (255, 255, 255))
        depth = cv2.GaussianBlur(shade, (0, 0), float(rng.uniform(2, 8))).astype(float) / 255 * rng.uniform(0.1, 0.4)
        pen.canvas[:] = np.clip(pen.canvas * (1 - depth), 0, 255).astype(np.uint8)
    _one_pointer(pen, shape, angle, reach, tail, half, colour)
    pen.disc(angle, (0, 0), hub, cap)
    return shape


def _one_pointer(pen: Pen, shape: str, angle: float, reach: float, tail: float, half: float, colour: Colour) -> None:
    pen.fill(angle, [(reach, 0.2 * half), (0.0, 1.5 * half), (0.0, -1.5 * half), (reach, -0.2 * half)], colour)
    match shape:
        case "spade":
            pen.fill(angle, [(0, half), (-tail, 3.0 * half), (-tail, -3.0 * half), (0, -half)], colour)
        case "bar":
            pen.fill(angle, [(0, half), (-tail, half), (-tail, -half), (0, -half)], colour)
            pen.fill(angle, [(-0.5 * tail, 0.06), (-tail, 0.06), (-tail, -0.06), (-0.5 * tail, -0.06)], colour)
        case "moon":
            pen.fill(angle, [(0, half), (-tail, half), (-tail, -half), (0, -half)], colour)
            pen.disc(angle, (-tail, 0), 0.09, colour)
        case _:
            pen.disc(angle, (0, 0), 0.1, colour)


def _photographed(pen: Pen, rng: Rng) -> Image:
    """Return the canvas behind glass, seen slightly at an angle, after light, lens, noise and JPEG."""
    aslant = seen_aslant(behind_glass(pen, rng), float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0, 0.08)))
    side = round(np.exp(rng.uniform(np.log(SMALLEST_PX), np.log(LARGEST_PX))))
    picture = np.asarray(cv2.resize(aslant, (side, side), interpolation=cv2.INTER_AREA), np.float32)
    return taken(picture, 0.5 + 0.005 * side, rng)


def behind_glass(pen: Pen, rng: Rng) -> Image:
    """Return the canvas of a pen, half of the times with a reflection in the glass over the face."""
    canvas = pen.canvas.astype(np.float32)
    return np.asarray(np.clip(_reflected(canvas, pen, rng) if rng.random() < 0.5 else canvas, 0, 255), np.uint8)


def taken(picture: NDArray[np.float32], most_blur_px: float, rng: Rng) -> Image:
    """Return a scene (H, W, 3) after lens, uneven light, noise and JPEG."""
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.3, most_blur_px))), np.float32)
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width]
    y, x = y / height, x / width
    light = (1 + rng.uniform(-0.4, 0.4) * (x - 0.5) + rng.uniform(-0.4, 0.4) * (y - 0.5)) * rng.uniform(0.4, 1.05)
    lit = picture * light[..., None] * rng.uniform(0.85, 1.0, 3)
    noisy = lit + rng.normal(0.0, float(rng.uniform(0.5, 5.0)), lit.shape)
    out = np.asarray(np.clip(noisy, 0, 255), np.uint8)
    coded = cv2.imencode(".jpg", out[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 95))])[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)[:, :, ::-1])


def _reflected(canvas: NDArray[np.float32], pen: Pen, rng: Rng) -> NDArray[np.float32]:
    """Add the reflection of a window or a lamp in the glass over the face."""
    y, x = np.mgrid[:CANVAS_PX, :CANVAS_PX].astype(np.float32)
    turn, at = rng.uniform(0, np.pi), rng.normal(0.0, 0.4, 2) * pen.radius
    along = (x - pen.middle[0] - at[0]) * np.cos(turn) + (y - pen.middle[1] - at[1]) * np.sin(turn)
    across = -(x - pen.middle[0] - at[0]) * np.sin(turn) + (y - pen.middle[1] - at[1]) * np.cos(turn)
    long, short = rng.uniform(0.15, 0.8) * pen.radius, rng.uniform(0.05, 0.25) * pen.radius
    spot = ((np.abs(along) < long) & (np.abs(across) < short)).astype(np.float32)
    spot = cv2.GaussianBlur(spot, (0, 0), float(rng.uniform(2, 25)))
    spot *= np.hypot(x - pen.middle[0], y - pen.middle[1]) < pen.radius
    return np.asarray(canvas + float(rng.uniform(20, 180)) * spot[..., None], np.float32)
