"""Merge criterion of two touching regions: whether one surface describes both at a lower cost than two (compiled)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.arrays import Array, Mask
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting import fit
from perception.range.fitting.equations import TRIM_SIGMAS
from perception.range.fitting.initialisation import start_plane
from perception.range.fitting.surfaces import PLANE, QUADRIC, SPHERE
from perception.range.segmentation import bend
from perception.range.segmentation.borders import step_and_turn
from perception.range.segmentation.finish import SLOW_NOISE_AREA_PX
from perception.range.segmentation.grid import slow_share_at

ROUNDS = as_numpy_scalar(3)  # of robust weights
STEP_SIGMAS = 3.0
SHARPEST_TURN_RAD = 1.2  # between facets of one narrow cylinder; an edge of a box turns by 1.57
SMOOTH_TURN_RAD = 0.05  # smaller angles are no crease
SMOOTH_SIGMAS = 3.0  # nor are angles below this multiple of the standard deviation of both tilts
SMOOTH_SHARE = 0.8  # least share of each part near the joint surface if no crease separates the parts
SMOOTH_LIMIT = 5.0  # sigmas; largest residual that counts as near in that case
LEAST_SHARE = 0.85  # least share of each part within the trim of the joint surface
UNEVEN_TURN_RAD = 0.25  # between facets of one uneven face
UNEVEN_SHARE = 0.02  # unevenness accepted in a face, as a ratio of the smaller facet's size
LEAST_GAIN = 1e-3  # gain of a merge that is made for another reason than its cost
SCRAP_SHARE = 0.1  # largest size of a fragment, relative to the larger part
PLAIN_MEAN_SQUARE = 1.6  # squared sigmas; limit of the mean square of a part with many independent noise values
MOST_NOISE = 2.5  # largest ratio of observed to modelled variance by which the limits are widened
# Mean square of a rough fit, with residuals cut at five sigmas, above which a full fit cannot reach the limits. GIVE_UP
# is used for two planes or a smooth border; otherwise the threshold is the limit plus SLACK.
GIVE_UP = 10.0
SLACK = 3.0


class Part(NamedTuple):
    """A region as the criterion sees it.

    Attributes:
        kind, th: kind and parameters (16,) of its surface.
        samples, normals: (4, N) samples, and (N, 3) normals of the surface there.
        pixels, patches: number of its pixels, and of independent noise values among them.
        mean_square: mean squared residual in squared sigmas.
        tilt_rad: standard deviation of its tilt.
        size_m: side of a square of its area.
    """

    kind: int
    th: Array
    samples: Array
    normals: Array
    pixels: float
    patches: float
    mean_square: float
    tilt_rad: float
    size_m: float


@compiled
def described(
    kind: int, th: Array, samples: Array, pixels: float, pitch: float, noise: Array, perspective: bool,
) -> Part:  # fmt: skip
    """Describe a region by the simplest suitable surface; `pitch`: distance between pixels in ray coordinates."""
    patches = max(pixels / (1.0 + slow_share_at(noise, np.median(samples[2])) * (SLOW_NOISE_AREA_PX - 1.0)), 1.0)
    kind, th = bend.simplest(kind, th, samples, perspective, patches)
    normals = bend.surface_normals(kind, th, samples, perspective)
    return _part(kind, th, samples, normals, pixels, patches, pitch, perspective)


@compiled
def _part(
    kind: int, th: Array, samples: Array, normals: Array, pixels: float, patches: float, pitch: float, perspective: bool,
) -> Part:  # fmt: skip
    """Build the description of a region.

    The standard deviation of its tilt is that of a plane fitted to noisy values, sigma / (spread sqrt(patches)), with
    the spread of the points in the direction in which it is least.
    """
    mean_square = bend.cut_mean_square(bend.residual_sizes(kind, th, samples, perspective), TRIM_SIGMAS)
    points = fit.points_of(samples, perspective)
    n = points.shape[0]
    mx, my = np.mean(points[:, 0]), np.mean(points[:, 1])
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(n):
        dx, dy = points[i, 0] - mx, points[i, 1] - my
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    least = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)) / max(n - 1, 1)
    tilt_rad = np.median(samples[3]) / np.sqrt(max(least, 1e-12) * patches)
    size_m = np.sqrt(pixels) * pitch * (np.median(samples[2]) if perspective else 1.0)
    return Part(kind, th, samples, normals, pixels, patches, mean_square, tilt_rad, size_m)


@compiled
def united(kind: int, th: Array, a: Part, b: Part, most: int, pitch: float, perspective: bool) -> Part:
    """Return the union of two regions, which the surface `kind`, `th` describes.

    Each region contributes an evenly spread choice of its samples, in proportion to its pixels but at least a fifth.
    There are at most `most` samples.
    """
    pixels, patches = a.pixels + b.pixels, a.patches + b.patches
    share = min(max(b.pixels / pixels, 0.2), 0.8)
    from_a = min(a.samples.shape[1], max(1, round((1.0 - share) * most)))
    from_b = min(b.samples.shape[1], max(1, round(share * most)))
    samples, normals = np.empty((4, from_a + from_b)), np.empty((from_a + from_b, 3))
    _spread(a, samples[:, :from_a], normals[:from_a])
    _spread(b, samples[:, from_a:], normals[from_a:])
    return _part(kind, th, samples, normals, pixels, patches, pitch, perspective)


@compiled
def _spread(part: Part, few: Array, few_normals: Array) -> None:
    """Fill `few` (4, n) and `few_normals` (n, 3) with an evenly spread choice of samples and normals."""
    n, last = few.shape[1], part.samples.shape[1] - 1
    step = last / max(n - 1, 1)
    for k in range(n):
        i = last if k == n - 1 and n > 1 else int(k * step)
        few[:, k] = part.samples[:, i]
        few_normals[k] = part.normals[i]


@compiled
def judged(
    a: Part, b: Part, x: Array, y: Array, noise: Array, perspective: bool,
) -> tuple[float, int, Array]:  # fmt: skip
    """Find the best joint surface of two regions that touch at the rays (x, y); returns its gain, kind and parameters.

    The gain is the cost of two surfaces minus that of one; with a gain of 0 or less the regions stay separate.
    """
    large, small = (a, b) if a.pixels >= b.pixels else (b, a)
    shown = shown_noise(a, b)
    step, turn = step_and_turn(a.kind, a.th, b.kind, b.th, x, y, noise, perspective)
    tolerated = max(SMOOTH_TURN_RAD, SMOOTH_SIGMAS * np.hypot(a.tilt_rad, b.tilt_rad))
    is_smooth = turn < min(tolerated, 0.5 * SHARPEST_TURN_RAD)
    if step <= STEP_SIGMAS * np.sqrt(shown) and turn <= SHARPEST_TURN_RAD:
        samples = np.concatenate((a.samples, b.samples), 1)
        limit = shown * max(mean_square_limit(a.patches), mean_square_limit(b.patches))
        both_flat = a.kind == PLANE and b.kind == PLANE
        give_up = GIVE_UP if both_flat or is_smooth else limit + SLACK
        with_quadric = QUADRIC in (a.kind, b.kind)
        kinds = np.ones(5, np.bool_)
        kinds[QUADRIC] = with_quadric
        own, continued = large.kind, large.th
        goes_on = own != PLANE and fit.rough_mean_square(own, continued, samples, perspective) <= give_up
        if goes_on:
            # If the surface of the larger region also explains the smaller one, no other kind needs to be tried.
            continued, _ = fit.fit_robust(own, continued, samples, perspective, ROUNDS)
            gain, _ = _gain(own, continued, a, b, is_smooth, perspective)
            if gain > LEAST_GAIN:
                return gain, own, continued
            kinds[own] = own == SPHERE and with_quadric  # an ellipsoid starts from a sphere
        correlated = max(samples.shape[1] / (a.patches + b.patches), 1.0)
        normals = np.concatenate((a.normals, b.normals))
        ths, _, kept, score = fit.fit_kinds(samples, normals, perspective, kinds, correlated, give_up)
        there = np.isfinite(score) & (kept > 0.5)
        if both_flat and not there[PLANE]:
            goes_on = True
            continued, _ = fit.fit_robust(PLANE, a.th, samples, perspective, ROUNDS)
        if goes_on:
            ths[own], there[own] = continued, True
        best_kind, best_gain, is_near = _best_fit(ths, there, a, b, is_smooth, perspective)
        if best_gain > 0.0 or is_near:
            return max(best_gain, LEAST_GAIN), best_kind, ths[best_kind].copy()
        if both_flat and turn < UNEVEN_TURN_RAD:
            th = start_plane(fit.points_of(samples, perspective))
            if _is_uneven(th, a, b, perspective):
                return LEAST_GAIN, PLANE, th
    if small.pixels > SCRAP_SHARE * large.pixels:
        return 0.0, large.kind, large.th
    gain = bend.scrap_gain(large.kind, large.th, small.kind, small.th, small.samples, small.pixels, noise, perspective)
    return gain, large.kind, large.th


@compiled
def _best_fit(
    ths: Array, there: Mask, a: Part, b: Part, is_smooth: bool, perspective: bool,
) -> tuple[int, float, bool]:  # fmt: skip
    """Return the kind with the largest gain among those that are `there` (5,), its gain, and whether any lies near.

    The kind is -1 where none is there. `ths` (5, SIZE): joint surface of each kind.
    """
    best_kind, best_gain, is_near = -1, -np.inf, False
    for kind in range(there.shape[0]):
        if there[kind]:
            gain, near = _gain(kind, ths[kind], a, b, is_smooth, perspective)
            is_near |= near
            if gain > best_gain:
                best_kind, best_gain = kind, gain
    return best_kind, best_gain, is_near


@compiled
def _gain(kind: int, th: Array, a: Part, b: Part, is_smooth: bool, perspective: bool) -> tuple[float, bool]:
    """Return the cost of two surfaces minus that of the joint surface; minus infinity if it does not describe both.

    Also returns whether the regions meet without a crease and lie near the joint surface. They are then merged
    regardless of the cost.
    """
    shown = shown_noise(a, b)
    apart, together = 0.0, bend.schwarz_price(kind, a.patches + b.patches)
    fits, near = True, is_smooth
    for part in (a, b):
        e = bend.residual_sizes(kind, th, part.samples, perspective)
        mean2 = bend.cut_mean_square(e, TRIM_SIGMAS)
        fits &= mean2 <= shown * mean_square_limit(part.patches) and bool(np.mean(e < TRIM_SIGMAS) >= LEAST_SHARE)
        near &= bool(np.mean(e < SMOOTH_LIMIT) > SMOOTH_SHARE)
        apart += bend.schwarz_price(part.kind, part.patches) + part.mean_square * part.patches / shown
        together += mean2 * part.patches / shown
    return apart - together if fits or near else -np.inf, near


@compiled
def _is_uneven(th: Array, a: Part, b: Part, perspective: bool) -> bool:
    """Return whether most of two facets is as near to the plane `th` as to that of uneven upholstery or cardboard."""
    tolerance_m = UNEVEN_SHARE * min(a.size_m, b.size_m)
    for part in (a, b):
        e = bend.residual_sizes(PLANE, th, part.samples, perspective) * part.samples[3]
        if not np.mean(e < tolerance_m) > SMOOTH_SHARE:
            return False
    return True


@compiled
def shown_noise(a: Part, b: Part) -> float:
    """Return the ratio of observed to modelled variance of two regions, from 1 to `MOST_NOISE`.

    It exceeds 1 on slanted faces, for example, where depth scatters more than the noise model says.
    """
    shown = (a.mean_square * a.patches + b.mean_square * b.patches) / (a.patches + b.patches)
    return float(min(max(1.0, shown), MOST_NOISE))


@compiled
def mean_square_limit(patches: float) -> float:
    """Return the limit 1 + 2 sqrt(2 / n) of the mean square of n residuals, but at least `PLAIN_MEAN_SQUARE`.

    A correct surface meets it with probability 0.97, because the mean square has the standard deviation sqrt(2 / n).
    """
    return float(max(PLAIN_MEAN_SQUARE, 1.0 + 2.0 * np.sqrt(2.0 / patches)))
