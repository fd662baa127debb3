"""Detection of cables that hang in front of a plate, and their removal from the picture.

A cable is a dark band of constant width that runs from the top of the plate to the bottom or to a side; nothing on a
panel is that long. Its course is the path with the largest darkness relative to both of its sides (dynamic programming,
R. Bellman, 1957; for lines in pictures U. Montanari, Comm. ACM 14(5), 1971). The covered pixels are interpolated from
side to side, row by row, which does not restore the picture but leaves no false edges.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled

Float32 = NDArray[np.float32]

ACROSS, ALONG = 2, 4  # size in px of a cell of the search
HALVES = np.array([1, 2, 3])  # possible values of half a cable's width, in cells
FULL = 0.25  # share of the plate's gray by which a band must be darker to have darkness 1
EVEN = 0.5  # darkness that is evidence neither for nor against a cable
LEAST = 0.03  # least mean darkness of a cable above `EVEN`, over the plate's height; 0.01 is the maximum without cables
BEND = 0.7  # cost of a change of slope by one
MARGIN = 12  # cells beside the plate, where a cable may run outside the picture
MOST = 3  # cables that are searched for
TAKEN = 4  # cells on either side of a cable in which no further one is searched for
SURE = 0.3  # darkness from which a cable is certain
AS_BRIGHT = 0.85  # gray over the plate's from which a cell is as bright as the plate
MOST_BRIGHT = 0.15  # share of such cells in a cable; between the labels of a lift panel 0.16 to 0.42 are
REACH_PX = 18  # half width of the strip along a course in which the width of the cable is measured
SHIFTS_PX = 6  # largest shift of a course when it is refined
SIDES_SEEN = 0.85  # a cable ends where this share of its contrast to the sides is lost
STEADY = 13  # rows over which the position of a cable is smoothed


def without_cables(picture: Image, plate_gray: Float32) -> Image:
    """Return the picture (H, W) of a plate with its cables interpolated away; the same picture if there are none."""
    height, width = picture.shape
    cells = (width // ACROSS, height // ALONG)
    whole = (slice(ALONG * cells[1]), slice(ACROSS * cells[0]))  # OpenCV is twice as fast by whole factors
    small, level = (cv2.resize(p[whole], cells, interpolation=cv2.INTER_AREA) for p in (picture, plate_gray))
    dark = _darkness(np.asarray(small, np.float32), np.asarray(level, np.float32) + np.float32(10.0), HALVES)
    shade = np.asarray(small / (level + np.float32(1.0)), np.float32)
    gain = np.pad(dark - np.float32(EVEN), ((0, 0), (MARGIN, MARGIN)))
    out = picture
    for _ in range(MOST):
        course, total = _course(gain, BEND)
        if total < LEAST * len(gain):
            break
        middle = _middle(out, plate_gray, course - MARGIN, dark) if _hides_plate(course - MARGIN, dark, shade) else None
        if middle is not None:
            out = _bridged(out, *middle)
        for row, at in enumerate(course):
            gain[row, max(at - TAKEN, MARGIN) : min(at + TAKEN + 1, MARGIN + cells[0])] = -EVEN
    return out


def _hides_plate(course: NDArray[np.int64], dark: Float32, shade: Float32) -> bool:
    """Return whether hardly any cell of a course, between its first and last sure one, is as bright as the plate.

    Between dark things in a row, such as labels or buttons, the plate shows. `shade`: gray over that of the plate.
    """
    rows = np.flatnonzero((course >= 0) & (course < dark.shape[1]))
    sure = np.flatnonzero(dark[rows, course[rows]] > SURE)
    if not len(sure):
        return False
    along = rows[sure[0] : sure[-1] + 1]
    return bool(np.mean(shade[along, course[along]] > AS_BRIGHT) < MOST_BRIGHT)


def _middle(
    picture: Image, plate_gray: Float32, course: NDArray[np.int64], dark: Float32
) -> tuple[NDArray[np.int64], Array, float] | None:
    """Return the rows (N,) that a cable crosses, its middle (N,) in them, and half of its width, px.

    None if it is too short. `course`: cell of the cable in every row of cells; `dark`: the result of `_darkness`.
    """
    height, width = picture.shape
    inside = (course >= 0) & (course < dark.shape[1])
    sure = np.flatnonzero(inside & (dark[np.arange(len(course)), np.clip(course, 0, dark.shape[1] - 1)] > SURE))
    if len(sure) < 2:
        return None
    first = 0 if sure[0] == 0 else ALONG * int(sure[0])
    last = height if sure[-1] >= len(course) - 2 else ALONG * (int(sure[-1]) + 1)
    rows = np.arange(first, last)
    at = np.interp(rows, ALONG * sure + 0.5 * (ALONG - 1), ACROSS * course[sure] + 0.5 * (ACROSS - 1))
    at = _steady(at)
    for _ in range(2):
        strip = _strip(picture, rows, at) / (plate_gray[rows, np.clip(at, 0, width - 1).astype(int)] + 10.0)[:, None]
        profile = np.median(strip, axis=0)
        low, high = _extent(profile)
        at = at + 0.5 * (low + high) - REACH_PX
        half = 0.5 * (high - low)
        at = _steady(at + _shift(strip, 0.5 * (low + high), half))
    return rows, at, half


def _strip(picture: Image, rows: NDArray[np.int64], at: Array) -> Array:
    """Return the gray values (N, 2 * REACH_PX + 1) across a course."""
    u = np.clip(np.round(at[:, None] + np.arange(-REACH_PX, REACH_PX + 1)), 0, picture.shape[1] - 1).astype(int)
    return np.asarray(picture[rows[:, None], u], float)


def _extent(profile: Array) -> tuple[int, int]:
    """Return the first and last pixel of the dark band in the middle of a profile."""
    side = float(np.median(np.r_[profile[:4], profile[-4:]]))
    core = REACH_PX + int(profile[REACH_PX - 3 : REACH_PX + 4].argmin()) - 3
    end = profile[core] + SIDES_SEEN * (side - profile[core])
    low = high = core
    while low > 2 and profile[low] < end:
        low -= 1
    while high < 2 * REACH_PX - 2 and profile[high] < end:
        high += 1
    return low, high


def _shift(strip: Array, middle: float, half: float) -> Array:
    """Return the offset (N,) of each row's darkest band from the middle, smoothed over neighbouring rows."""
    reach = max(1, round(half) - 1)
    sums = np.pad(np.cumsum(strip, axis=1), ((0, 0), (1, 0)))
    tried = np.clip(round(middle) + np.arange(-SHIFTS_PX, SHIFTS_PX + 1), reach + 4, strip.shape[1] - reach - 5)
    core = (sums[:, tried + reach + 1] - sums[:, tried - reach]) / (2 * reach + 1)
    sides = np.minimum(
        (sums[:, tried - reach - 1] - sums[:, tried - reach - 4]) / 3,
        (sums[:, tried + reach + 5] - sums[:, tried + reach + 2]) / 3,
    )
    alone = np.clip((sides - core) / FULL, -0.5, 1.0)
    seen = np.asarray(cv2.blur(alone, (1, STEADY), borderType=cv2.BORDER_REFLECT), float)
    rows = np.arange(len(seen))
    sure = np.flatnonzero(seen.max(axis=1) > SURE)
    if len(sure) < 2:
        return np.zeros(len(seen))
    return np.asarray(np.interp(rows, sure, tried[seen[sure].argmax(axis=1)] - middle))


def _steady(at: Array) -> Array:
    """Return the positions (N,) smoothed along the cable, with its ends unchanged."""
    reach = STEADY // 2
    if len(at) <= reach:
        return at
    framed = np.r_[2 * at[0] - at[reach:0:-1], at, 2 * at[-1] - at[-2 : -reach - 2 : -1]]
    return np.asarray(np.convolve(framed, np.full(STEADY, 1 / STEADY), mode="valid"))


def _bridged(picture: Image, rows: NDArray[np.int64], at: Array, half: float) -> Image:
    """Return the picture with the band replaced in every row by a linear interpolation between its two sides."""
    out = picture.copy()
    _bridge(out, rows, np.floor(at - half).astype(np.int64) - 1, np.ceil(at + half).astype(np.int64) + 1)
    return out


@compiled
def _bridge(picture: Image, rows: NDArray[np.int64], left: NDArray[np.int64], right: NDArray[np.int64]) -> None:
    """Interpolate the given rows in place; a side outside the picture gets the gray of the other side."""
    width = picture.shape[1]
    for k in range(len(rows)):
        row = picture[rows[k]]
        a, b = left[k], right[k]
        if b < 1 or a > width - 2:
            continue
        from_left = 0.5 * (row[a] + row[a - 1]) if a >= 1 else -1.0
        from_right = 0.5 * (row[b] + row[b + 1]) if b <= width - 2 else from_left
        if from_left < 0:
            from_left = from_right
        for x in range(max(a, 0), min(b, width - 1) + 1):
            picture[rows[k], x] = np.uint8(from_left + (from_right - from_left) * (x - a) / (b - a) + 0.5)


@compiled
def _darkness(small: Float32, level: Float32, halves: NDArray[np.int64]) -> Float32:
    """Return the darkness (H, W) of a band around each cell relative to both of its sides.

    It is the maximum over the half widths `halves`, in cells. `level`: gray of the plate.
    """
    height, width = small.shape
    out = np.full((height, width), np.float32(-0.5))
    sums = np.zeros(width + 1, np.float32)
    for y in range(height):
        for x in range(width):
            sums[x + 1] = sums[x] + small[y, x]
        for k in halves:
            gap = k + 2
            for x in range(gap + 1, width - gap - 1):
                band = (sums[x + k + 1] - sums[x - k]) / (2 * k + 1)
                before = 0.5 * (sums[x - gap + 1] - sums[x - gap - 1])
                after = 0.5 * (sums[x + gap + 2] - sums[x + gap])
                found = (min(before, after) - band) / (FULL * level[y, x])
                out[y, x] = max(out[y, x], min(found, np.float32(1.0)))
    return out


@compiled
def _course(gain: Float32, bend: float) -> tuple[NDArray[np.int64], float]:
    """Return the cell (H,) per row of the top-to-bottom path with the largest gain, and that gain.

    The path moves at most two cells sideways per row; a change of its slope costs `bend`.
    """
    height, width = gain.shape
    slopes = 5
    price = np.float32(bend)
    total = np.empty((2, slopes, width), np.float32)
    came = np.zeros((height, slopes, width), np.int8)
    for s in range(slopes):
        total[0, s] = gain[0]
    for y in range(1, height):
        before, here = total[(y - 1) % 2], total[y % 2]
        for s in range(slopes):
            lower, upper = max(s - 1, 0), min(s + 1, slopes - 1)
            for x in range(width):
                at = min(max(x - s + 2, 0), width - 1)
                best, slope = before[s, at], s
                if before[lower, at] - price > best:
                    best, slope = before[lower, at] - price, lower
                if before[upper, at] - price > best:
                    best, slope = before[upper, at] - price, upper
                here[s, x] = best + gain[y, x]
                came[y, s, x] = slope
    last = total[(height - 1) % 2]
    s, x = divmod(int(last.argmax()), width)
    most = float(last[s, x])
    course = np.empty(height, np.int64)
    for y in range(height - 1, -1, -1):
        course[y] = x
        s, x = int(came[y, s, x]), min(max(x - s + 2, 0), width - 1)
    return course, most
