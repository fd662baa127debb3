"""Detection of the plate in an overview: four robust lines around the region that differs from the room.

The projection of a rigid plate by a typical camera is fitted to the lines and then to the image's edges, so that a side
outside the image follows from the others; if they do not determine it, it is placed at the image's border. If edges do
not confirm a visible side (glare or shadow misled its line), the fit is repeated without that line. Each fit is also
tried with wider search windows, and as a free homography for steep tilts and wide lenses. The fit with the most
confirmed edges is returned.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled
from perception.vision.finding.plate_pose import rigid_plate
from perception.vision.projection import PlateProjection, homography
from perception.vision.registration.outline import Outline, rectangle
from perception.vision.registration.register import EdgeImage, confirmed, edge_image, follow_edges

COARSE_WIDTH_PX = 160
# Focal length over the longer image side, a lens of 44 degrees; used to complete a side that is cut off.
TYPICAL_FOCAL = 1.25
LEAST_SHARE = 0.25  # of the image; with a smaller plate it is no overview
LEAST_SIDE = 0.12  # least share of a side's length whose edge is in the image; with less the side counts as cut off
SIDE_POINTS = 40  # samples per side
WINDOWS_PX = (12.0, 8.0, 5.0, 3.0, 2.0)
FAR_WINDOWS_PX = (30.0, 20.0, *WINDOWS_PX)  # for a plate whose lines were wrong
# Standard deviations of the corners with the normal and with the wider windows.
START_SIGMA_PX, FAR_SIGMA_PX = 6.0, 15.0
FREE_WINDOWS_PX = (5.0, 3.0, 2.0)  # of the last step, which allows for an untypical lens and focal length
FREE_SIGMA_PX = 2.0
LEAST_SIDES = 2  # least number of sides that are visible as lines; a single line may be any edge
# Share of the image that a plate fills from which one line is enough, as the other sides are at the image's border.
FILLED = 0.85
CONFIRMED = 0.7  # share of a side's visible part that is an edge
LEAST_CONFIRMED = SIDE_POINTS // 4  # least number of confirmed samples in all; noise and soft shadows give none
LEAST_SHARE_CONFIRMED = 0.55  # of the visible border; most close-ups and bare walls have less
# Least share, sides and visible samples per side for `is_sure`; all development overviews reach the share.
SURE_SHARE, SURE_SIDES, SURE_SIDE_VISIBLE = 0.9, 3, 16
MOST_STRETCHED = 1.45  # see `_stretch`; a plate rotated by a quarter turn has the square of its proportions, 1.8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plate:
    """A plate found in an image.

    Attributes:
        view: projection from plate metres (origin in the middle, y up) to pixels.
        sides_seen: whether the image shows the top, right, bottom and left side.
        is_sure: whether the border alone confirms the plate; if not, it may be the edge of something else.
    """

    view: PlateProjection
    sides_seen: tuple[bool, bool, bool, bool]
    is_sure: bool


def find_plate(gray: Image, width_m: float, height_m: float, *, focal_px: float | None = None) -> Plate | None:
    """Return the plate of known size that fills most of the image, upright within 45 degrees; None if there is none."""
    shrink = max(1.0, gray.shape[1] / COARSE_WIDTH_PX)
    small = np.asarray(cv2.resize(gray, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA), np.uint8)
    mask = _plate_mask(small)
    if mask.mean() < LEAST_SHARE:
        return None
    lines = [_side(mask, side) for side in range(4)]
    seen = sum(line is not None for line in lines)
    if not seen or (seen < LEAST_SIDES and mask.mean() < FILLED):
        return None
    w, h = width_m / 2, height_m / 2
    search = _Search(
        image=edge_image(gray), outline=rectangle(0.0, 0.0, 0.0, width_m=width_m, height_m=height_m, count=SIDE_POINTS),
        corners_m=np.array([[-w, h], [w, h], [w, -h], [-w, -h]]), coarse_shape=mask.shape, shrink=shrink,
        focal_px=focal_px or TYPICAL_FOCAL * max(gray.shape),
    )  # fmt: skip
    found = search.best(lines)
    if found is None:
        return None
    top, right, bottom, left = (line is not None for line in lines)
    return Plate(view=found, sides_seen=(top, right, bottom, left), is_sure=search.is_sure(found))


_Attempt = tuple[list[Array | None], tuple[float, ...], float]  # lines, windows in pixels, sigma in pixels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Search:
    """Data that every attempt to fit the plate to coarse lines needs."""

    image: EdgeImage
    outline: Outline
    corners_m: Array
    coarse_shape: tuple[int, ...]
    shrink: float
    focal_px: float

    def best(self, lines: list[Array | None]) -> PlateProjection | None:
        """Return the plate that the image's edges confirm best; None if no attempt gives a confirmed plate."""
        view = self._laid(lines, WINDOWS_PX, START_SIGMA_PX)
        found = [] if view is None else [(self._score(view), view)]
        if view is None or self._least_confirmed(view) < CONFIRMED:
            attempts: list[_Attempt] = [(lines, FAR_WINDOWS_PX, FAR_SIGMA_PX)]
            for side in (k for k, line in enumerate(lines) if line is not None):
                fewer = [None if k == side else line for k, line in enumerate(lines)]
                attempts += [(fewer, WINDOWS_PX, START_SIGMA_PX), (fewer, FAR_WINDOWS_PX, FAR_SIGMA_PX)]
            laid = [self._free(lines), *(self._laid(*attempt) for attempt in attempts)]
            found += [(self._score(view), view) for view in laid if view is not None]
        best = max(found, key=lambda f: f[0])[1] if found else None
        return best if best is not None and self._is_plate(best) else None

    def _is_plate(self, view: PlateProjection) -> bool:
        """Return whether edges confirm enough of the border and the camera allows the plate's proportions."""
        visible, near = (int(mask.sum()) for mask in confirmed(self.image, view, self.outline))
        is_confirmed = near >= max(LEAST_CONFIRMED, LEAST_SHARE_CONFIRMED * visible)
        return is_confirmed and self._stretch(view) < MOST_STRETCHED

    def is_sure(self, view: PlateProjection) -> bool:
        """Return whether edges confirm nearly all of the visible border; its size requires at least three sides."""
        visible, near = (mask.reshape(4, -1).sum(axis=1) for mask in confirmed(self.image, view, self.outline))
        sides = (visible >= SURE_SIDE_VISIBLE) & (2 * near > visible)
        return bool(sides.sum() >= SURE_SIDES and near.sum() >= SURE_SHARE * visible.sum())

    def _stretch(self, view: PlateProjection) -> float:
        """Return the ratio of the scales of the plate's two directions for a camera of the known focal length.

        The columns of K^-1 H of a rigid plate have the same length, so the ratio is 1; a focal length that is wrong by
        half gives 1.2 at a tilt of 40 degrees.
        """
        rows, columns = self.image.smooth.shape
        K = np.array([[self.focal_px, 0, (columns - 1.0) / 2], [0, self.focal_px, (rows - 1.0) / 2], [0, 0, 1.0]])
        across, up = np.linalg.norm(np.linalg.solve(K, view.px_from_plate)[:, :2], axis=0)
        return float(max(across, up) / max(min(across, up), 1e-9))

    def _laid(
        self, lines: list[Array | None], windows_px: tuple[float, ...], sigma_px: float
    ) -> PlateProjection | None:
        """Fit the plate to the lines and then to the image's edges: first as a rigid plate, then freely."""
        corners_px = self._corners_px(lines)
        if corners_px is None:
            return None
        rows, columns = self.image.smooth.shape
        rigid = rigid_plate(
            self.corners_m, corners_px, focal_px=self.focal_px, sigma_px=sigma_px,
            middle_px=np.array([columns - 1.0, rows - 1.0]) / 2,
        )  # fmt: skip
        rigid = follow_edges(self.image, rigid, self.outline, windows_px)
        free = PlateProjection(px_from_plate=rigid.px_from_plate, corners_m=self.corners_m, sigma_px=FREE_SIGMA_PX)
        return follow_edges(self.image, free, self.outline, FREE_WINDOWS_PX)

    def _free(self, lines: list[Array | None]) -> PlateProjection | None:
        """Fit the plate to four lines as a free homography, because an atypical lens matters at a steep tilt."""
        corners_px = self._corners_px(lines) if all(line is not None for line in lines) else None
        if corners_px is None:
            return None
        H = homography(self.corners_m, corners_px)
        view = PlateProjection(px_from_plate=H, corners_m=self.corners_m, sigma_px=START_SIGMA_PX)
        return follow_edges(self.image, view, self.outline, WINDOWS_PX)

    def _corners_px(self, lines: list[Array | None]) -> Array | None:
        """Return the corners (4, 2) in the image itself; None if the lines do not determine them."""
        width, height = self.corners_m.max(axis=0) * 2
        corners = _corners(lines, self.coarse_shape, float(width / height), self.focal_px / self.shrink)
        return None if corners is None else (corners + 0.5) * self.shrink - 0.5

    def _score(self, view: PlateProjection) -> int:
        """Return the number of border samples that an edge confirms, minus the visible ones that none confirms."""
        visible, near = confirmed(self.image, view, self.outline)
        return 2 * int(near.sum()) - int(visible.sum())

    def _least_confirmed(self, view: PlateProjection) -> float:
        """Return the least share of confirmed samples among the sides of which enough is visible."""
        visible, near = (mask.reshape(4, -1).sum(axis=1) for mask in confirmed(self.image, view, self.outline))
        return float(np.where(visible >= SIDE_POINTS // 5, near / np.maximum(visible, 1), 1.0).min())


def _plate_mask(small: Image) -> NDArray[np.bool_]:
    """Return the largest bright or dark region around the middle of the picture."""
    smooth = cv2.GaussianBlur(small, (0, 0), 1.5)
    # In logarithms a plate's ratio to the room is constant even if the light fades; glare and white faces are capped.
    level = np.log(smooth.astype(np.float32) + 4.0)
    low, median = (float(x) for x in np.percentile(level, (1, 50)))
    held = np.minimum(level, median + 0.2)
    high = float(held.max())
    coded = np.clip((held - low) / max(high - low, 1e-3) * 255.0, 0, 255).astype(np.uint8)
    _, bright = cv2.threshold(coded, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    middle = bright[bright.shape[0] // 4 : -bright.shape[0] // 4, bright.shape[1] // 4 : -bright.shape[1] // 4]
    mask = bright if middle.mean() >= 0.5 else 1 - bright
    mask = cv2.morphologyEx(np.pad(mask, 12), cv2.MORPH_CLOSE, np.ones((13, 13), np.uint8))[12:-12, 12:-12]
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return np.zeros(mask.shape, bool)
    return np.asarray(labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))


def _side(mask: NDArray[np.bool_], side: int) -> Array | None:
    """Return (a, b, c) of the line a x + b y = c along the top, right, bottom or left border of the mask.

    `side` is 0 to 3. None if the image cuts that side off.
    """
    turned = mask if side in (0, 2) else mask.T
    columns = np.flatnonzero(turned.any(axis=0))
    if len(columns) < 12:
        return None
    columns = columns[len(columns) // 12 : -len(columns) // 12]
    last = turned.shape[0] - 1
    first = turned[:, columns].argmax(axis=0) if side in (0, 3) else last - turned[::-1, columns].argmax(axis=0)
    free = (first > 1) & (first < last - 1)
    if free.mean() < LEAST_SIDE:
        return None
    x, y = columns[free].astype(float), first[free].astype(float) + (-0.5 if side in (0, 3) else 0.5)
    slope, start = _robust_line(x, y)
    line = np.array([-slope, 1.0, start])
    return line if side in (0, 2) else line[[1, 0, 2]]


@compiled
def _robust_line(x: Array, y: Array) -> tuple[float, float]:
    """Return slope and intercept by least squares with Cauchy weights, starting from medians."""
    half = len(x) // 2
    slope = float(np.median((y[half : half * 2] - y[:half]) / np.maximum(x[half : half * 2] - x[:half], 1e-9)))
    start = float(np.median(y - slope * x))
    for _ in range(8):
        r = y - slope * x - start
        w = 1.0 / (1.0 + (r / max(1.5 * float(np.median(np.abs(r))), 0.4)) ** 2)
        mean_x, mean_y = (w * x).sum() / w.sum(), (w * y).sum() / w.sum()
        slope = (w * (x - mean_x) * (y - mean_y)).sum() / (w * (x - mean_x) ** 2).sum()
        start = mean_y - slope * mean_x
    return slope, start


def _corners(lines: list[Array | None], shape: tuple[int, ...], aspect: float, focal: float) -> Array | None:
    """Return the corners (4, 2), upper left first and clockwise; the known proportions determine a missing side.

    `focal`: focal length in pixels of this image; `aspect`: width over height of the plate.
    """
    height, width = shape
    border = [
        np.array([0.0, 1.0, -0.5]),
        np.array([1.0, 0.0, width - 0.5]),
        np.array([0.0, 1.0, height - 0.5]),
        np.array([1.0, 0.0, -0.5]),
    ]
    full = [line if line is not None else edge for line, edge in zip(lines, border, strict=True)]
    corners = _cuts(np.roll(full, 1, axis=0), np.array(full))
    if not np.isfinite(corners).all():
        return None
    missing = [k for k, line in enumerate(lines) if line is None]
    if len(missing) == 1:
        return _completed(
            corners, missing[0], middle=np.array([width - 1.0, height - 1.0]) / 2, focal=focal, aspect=aspect
        )
    return corners


def _completed(corners: Array, missing: int, *, middle: Array, focal: float, aspect: float) -> Array | None:
    """Return the corners of a rectangle of known proportions of which one side is cut off.

    The two sides next to the missing one intersect in the vanishing point of their direction d; the opposite side lies
    in the plane through the camera with normal m. The other direction is m x d, so the whole plane is known.
    """
    order = np.roll(np.arange(4), -missing)  # the missing side runs from order[0] to order[1]
    far_a, far_b, near_b, near_a = corners[order]
    ratio = (
        aspect if missing in (1, 3) else 1.0 / aspect
    )  # of the sides that meet the missing one over the opposite one
    a, b = (np.append(p - middle, focal) for p in (near_a, near_b))
    m = np.cross(a, b)
    d = np.cross(np.cross(a, np.append(far_a - middle, focal)), np.cross(b, np.append(far_b - middle, focal)))
    d = d / np.linalg.norm(d)
    across = np.cross(m, d)
    across = across / np.linalg.norm(across)
    # b is on the ray of near_b, and b - a is along `across`: a + length * across = t * ray_b, with a at depth 1.
    solved = np.linalg.lstsq(np.column_stack([across, -b]), -a, rcond=None)[0]
    length = abs(float(solved[0])) * ratio
    towards = (
        1.0
        if float(np.dot((a + 0.1 * length * d)[:2] / (a + 0.1 * length * d)[2] - a[:2] / a[2], far_a - near_a)) > 0
        else -1.0
    )
    out = corners.copy()
    for index, start in ((order[0], a), (order[1], b * float(solved[1]))):
        point = start + towards * length * d
        if point[2] <= 0:
            return None
        out[index] = middle + focal * point[:2] / point[2]
    return out


def _cuts(first: Array, second: Array) -> Array:
    """Return the intersections (N, 2) of lines (N, 3; a x + b y = c), by Cramer's rule; not finite if they are parallel."""
    (a, b, c), (d, e, f) = first.T, second.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.stack([c * e - b * f, a * f - c * d], axis=1) / (a * e - b * d)[:, None])
