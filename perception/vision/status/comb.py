"""Where the digit cells of a seven-segment display are: slant, rows, pitch and width that explain the most ink.

A comb is first guessed per slant on the profile of those rows that only upright segments cross, then judged by the ink
that its segments explain: the projection of the picture on one flat template a segment, sum(ink)^2 / area.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.patch import sample_at
from perception.vision.view import Array

Float32 = NDArray[np.float32]

SEGMENTS = "abcdefg"  # top, upper right, lower right, bottom, lower left, upper left, middle
#: Ends of every segment's axis in a cell of unit width and height, y down.
AXES = np.array([
    [[0, 0], [1, 0]], [[1, 0], [1, 0.5]], [[1, 0.5], [1, 1]], [[0, 1], [1, 1]], [[0, 0.5], [0, 1]], [[0, 0], [0, 0.5]],
    [[0, 0.5], [1, 0.5]],
])  # fmt: skip
IS_FLAT = AXES[:, 0, 1] == AXES[:, 1, 1]
INKED_SHARE = 0.8  # of an axis that its segment fills
ALONG = np.linspace(0.22, 0.78, 5)  # sampled part of a segment's axis: its ends meet other segments
STROKE = 0.05  # half of a stroke's width over the digit height

SLANTS = np.tan(np.deg2rad([0.0, 3.0, 6.0, 9.0, 12.0, 15.0]))
WIDTHS = np.array([0.40, 0.46, 0.52, 0.58, 0.65])  # between the uprights' axes, over the digit height
MIN_PITCH = 1.2
PITCHES = np.geomspace(1.25, 2.6, 22)  # over that width
ROW_SHIFTS = (
    (0.0, 0.0),
    (-0.07, 0.0),
    (0.0, -0.08),
    (-0.07, 0.06),
    (0.0, 0.06),
    (0.07, -0.06),
)  # top and bottom, over the height
REFINED = 3
REFINE_STEPS = (0.05, 0.025, 0.012)  # of the digit height


@dataclass(frozen=True, slots=True, kw_only=True)
class Comb:
    """Digit cells in picture pixels. `left_px` is the axis of the first cell's left uprights at half height.

    `width_px` lies between the axes of a cell's uprights, `top_px` and `bottom_px` are the axes of top and bottom
    segments, `slant` is the tangent of the lean to the right.
    """

    left_px: float
    pitch_px: float
    width_px: float
    top_px: float
    bottom_px: float
    slant: float
    count: int

    def place(self, x: Array, y: Array, cell: Array) -> tuple[Array, Array]:
        """Pixel of cell coordinates: x from 0 (left upright) to 1, y from 0 (top) to 1."""
        v = self.top_px + y * (self.bottom_px - self.top_px)
        lean = self.slant * ((self.top_px + self.bottom_px) / 2 - v)
        return self.left_px + cell * self.pitch_px + x * self.width_px + lean, v


def find_combs(ink: Float32, counts: Sequence[int], *, free: float = 0.12) -> list[tuple[float, Comb]]:
    """(explained share of the ink, comb) of the best combs near the middle of the picture, at most one a count.

    Args:
        ink: (H, W) how much every pixel differs from the background, as segments do.
        counts: numbers of cells to try; only the most promising are refined.
        free: how far the comb's middle may lie from the picture's, over the picture's width.
    """
    rows = _digit_rows(ink)
    total = float((ink.astype(float) ** 2).sum())
    if rows is None or total <= 0:
        return []
    rough = [found for count in counts if (found := _rough(ink, rows, count, free, total)) is not None]
    rough.sort(key=lambda found: found[0], reverse=True)
    refined = [_refined(ink, comb, score, total) for score, comb in rough[:REFINED]]
    return refined + _extended(ink, refined, counts, total)


def _extended(
    ink: Float32, found: list[tuple[float, Comb]], counts: Sequence[int], total: float
) -> list[tuple[float, Comb]]:
    """The combs with one more cell on either side: a sign or a one says little about where its cell is."""
    longer = [
        replace(comb, count=comb.count + 1, left_px=comb.left_px - shift * comb.pitch_px)
        for _, comb in found for shift in (0, 1) if comb.count + 1 in counts
    ]  # fmt: skip
    longer = [comb for comb in longer if _is_sound(comb, ink.shape)]
    return [(float(explained(ink, [comb])[0]) / total, comb) for comb in longer]


def _rough(ink: Float32, rows: tuple[float, float], count: int, free: float, total: float) -> tuple[float, Comb] | None:
    height = rows[1] - rows[0]
    combs = [
        replace(comb, top_px=comb.top_px + a * height, bottom_px=comb.bottom_px + b * height)
        for slant in SLANTS
        for comb in _guesses(ink, rows, float(slant), count, free)
        for a, b in ROW_SHIFTS
    ]
    combs = [comb for comb in combs if _is_sound(comb, ink.shape)]
    if not combs:
        return None
    scores = explained(ink, combs) / total
    k = int(scores.argmax())
    return float(scores[k]), combs[k]


def segment_levels(ink: Float32, comb: Comb) -> Array:
    """(cells, 7) ink of every segment: the median along its axis of the best across its stroke."""
    values = _sampled(ink, [comb])[0]
    return np.asarray(np.median(values.max(axis=3), axis=2), float)


def loop_levels(ink: Float32, comb: Comb) -> Array:
    """(cells, 2) ink in the middle of the upper and the lower loop of every cell, where no segment is."""
    cell = np.repeat(np.arange(comb.count, dtype=float), 2)
    u, v = comb.place(np.full(2 * comb.count, 0.5), np.tile([0.25, 0.75], comb.count), cell)
    return np.asarray(sample_at(ink, u, v, outside=0.0), float).reshape(comb.count, 2)


def explained(ink: Float32, combs: Sequence[Comb]) -> Array:
    """(N,) squared ink that flat segment templates explain."""
    width, height = np.array([(c.width_px, c.bottom_px - c.top_px) for c in combs]).T[:, :, None, None]
    area = np.where(IS_FLAT, width, height / 2) * INKED_SHARE * 2 * STROKE * height
    means = np.maximum(_sampled(ink, combs), 0.0).mean(axis=(3, 4))
    return np.asarray((means**2 * area).sum(axis=(1, 2)), float)


def _sampled(ink: Float32, combs: Sequence[Comb]) -> Array:
    """(N, cells, 7, along, across) ink on every segment of every comb."""
    column = [
        np.array([getattr(c, name) for c in combs])[:, None, None, None, None]
        for name in ("left_px", "pitch_px", "width_px", "top_px", "bottom_px", "slant")
    ]
    left, pitch, width, top, bottom, slant = column
    height = bottom - top
    start, end = AXES[:, 0], AXES[:, 1]
    axis = start[:, None, :] + ALONG[None, :, None] * (end - start)[:, None, :]  # (7, along, 2)
    flat = IS_FLAT[:, None, None]
    across = np.array([-1.0, 0.0, 1.0]) * STROKE * 0.8
    cell = np.arange(combs[0].count)[None, :, None, None, None]
    v = top + (axis[None, None, :, :, 1, None] + np.where(flat, across, 0.0)[None, None]) * height
    u = left + cell * pitch + axis[None, None, :, :, 0, None] * width + np.where(flat, 0.0, across)[None, None] * height
    u = u + slant * ((top + bottom) / 2 - v)
    u, v = np.broadcast_arrays(u, v)
    shape = u.shape
    flat_values = sample_at(ink, u.reshape(len(combs), -1), v.reshape(len(combs), -1), outside=0.0)
    return np.asarray(flat_values.reshape(shape), float)


def _refined(ink: Float32, comb: Comb, score: float, total: float) -> tuple[float, Comb]:
    """Coordinate search around a comb."""
    for step in REFINE_STEPS:
        d = step * (comb.bottom_px - comb.top_px)
        last = max(1, comb.count - 1)
        moves = [
            {"left_px": comb.left_px + s * d} for s in (-1, 1)] + [
            {"pitch_px": comb.pitch_px + s * d / last} for s in (-1, 1)] + [
            {"pitch_px": comb.pitch_px + s * d / last, "left_px": comb.left_px - s * d} for s in (-1, 1)] + [
            {"width_px": comb.width_px + s * d, "left_px": comb.left_px - s * d / 2} for s in (-1, 1)] + [
            {"top_px": comb.top_px + s * d} for s in (-1, 1)] + [
            {"bottom_px": comb.bottom_px + s * d} for s in (-1, 1)] + [
            {"slant": comb.slant + s * step} for s in (-1, 1)]  # fmt: skip
        for _ in range(3):
            tried = [_moved(comb, move) for move in moves]
            scores = np.where([_is_sound(c, ink.shape) for c in tried], explained(ink, tried) / total, -1.0)
            k = int(scores.argmax())
            if scores[k] <= score:
                break
            change = {key: value - getattr(comb, key) for key, value in moves[k].items()}
            comb, score = tried[k], float(scores[k])
            moves = [{key: value + change.get(key, 0.0) for key, value in move.items()} for move in moves]
    return score, comb


def _moved(comb: Comb, move: dict[str, float]) -> Comb:
    return replace(comb, **move)  # type: ignore[arg-type]  # only its float fields are moved


def _is_sound(comb: Comb, shape: tuple[int, ...]) -> bool:
    """Whether cells keep apart (else neighbours would share an upright), stay in the picture and look like digits."""
    height = comb.bottom_px - comb.top_px
    right = comb.left_px + (comb.count - 1) * comb.pitch_px + comb.width_px
    return (
        comb.pitch_px >= MIN_PITCH * comb.width_px
        and 0.33 <= comb.width_px / height <= 0.72
        and comb.left_px >= -0.1 * comb.width_px
        and right <= shape[1] + 0.1 * comb.width_px
        and comb.top_px >= 0 and comb.bottom_px <= shape[0] - 1
        and -0.06 <= comb.slant <= 0.32
    )  # fmt: skip


def _digit_rows(ink: Float32) -> tuple[float, float] | None:
    """Rows of the top and bottom segments' axes: where the ink begins and ends."""
    strong = float(np.percentile(ink, 99))
    if strong < 3.0:
        return None
    profile = (ink > 0.45 * strong).sum(axis=1).astype(float)
    there = np.flatnonzero(profile >= max(2.0, 0.15 * profile.max()))
    if len(there) < 6 or there[-1] - there[0] < 0.25 * ink.shape[0]:
        return None
    half_stroke = STROKE * (there[-1] - there[0])
    return float(there[0] + half_stroke), float(there[-1] - half_stroke)


def _guesses(ink: Float32, rows: tuple[float, float], slant: float, count: int, free: float) -> list[Comb]:
    """Combs at one slant by the upright profile: ink on the uprights, none between them."""
    top, bottom = rows
    height = bottom - top
    middle = (top + bottom) / 2
    shear = np.array([[1.0, -slant, slant * middle], [0.0, 1.0, 0.0]])
    upright = cv2.warpAffine(ink, shear, ink.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    take = top + height * np.concatenate([np.linspace(0.17, 0.38, 6), np.linspace(0.62, 0.83, 6)])
    profile = upright[np.clip(np.round(take).astype(int), 0, len(ink) - 1)].mean(axis=0)
    profile = cv2.GaussianBlur(profile[None].astype(np.float32), (0, 0), max(0.05 * height, 0.8))[0]
    size = ink.shape[1]
    width = (WIDTHS * height)[:, None, None]
    pitch = width * PITCHES[None, :, None]
    span = (count - 1) * pitch + width
    lefts = (size - span) / 2 + np.linspace(-free, free, 15) * size
    cells = np.arange(count)
    columns = lefts[..., None] + cells * pitch[..., None]
    hit = _read(profile, columns) + _read(profile, columns + width[..., None])
    miss = _read(profile, columns + width[..., None] / 2)
    miss = miss + _read(profile, columns + (width + pitch)[..., None] / 2)
    off = np.abs(np.linspace(-1.0, 1.0, 15))
    sound = (lefts >= -0.1 * width) & (lefts + span <= size + 0.1 * width)
    score = np.where(sound, (hit - 1.2 * miss) * (1.0 - 0.25 * off), -1.0)
    found = []
    for w in range(len(WIDTHS)):
        p, k = np.unravel_index(int(score[w].argmax()), score.shape[1:])
        if score[w, p, k] > 0:
            found.append(
                Comb(
                    left_px=float(lefts[w, p, k]),
                    pitch_px=float(pitch[w, p, 0]),
                    width_px=float(width[w, 0, 0]),
                    top_px=top,
                    bottom_px=bottom,
                    slant=slant,
                    count=count,
                )
            )
    return found


def _read(profile: Float32, columns: Array) -> Array:
    """Sum over the last axis of the profile at columns; nothing outside."""
    index = np.round(columns).astype(int)
    inside = (index >= 0) & (index < len(profile))
    return np.asarray((profile[np.clip(index, 0, len(profile) - 1)] * inside).sum(axis=-1), float)
