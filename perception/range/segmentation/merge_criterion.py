"""Merge criterion of two touching regions: whether one surface describes both at a lower cost than two (compiled).

A region is given by its kind, parameters, (4, N) samples, their (N, 3) normals on its surface, and its figures. These
are the number of pixels (PIXELS), the number of independent noise values among them (PATCHES), the mean squared
residual in squared sigmas (MEAN_SQUARE), the standard deviation of its tilt in radians (TILT), and the side of a square
of its area in metres (SIZE_M). `pitch` is the distance between pixels in ray coordinates.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Mask
from hal.jit import as_numpy_scalar, compiled
from hal.small_algebra import solve_positive
from perception.range.fitting import fit
from perception.range.fitting.initialisation import start_plane
from perception.range.fitting.surfaces import PLANE, QUADRIC, SPHERE
from perception.range.segmentation import bend
from perception.range.segmentation.borders import step_and_turn
from perception.range.segmentation.finish import SLOW_NOISE_AREA_PX
from perception.range.segmentation.grid import slow_share_at

PIXELS, PATCHES, MEAN_SQUARE, TILT, SIZE_M = range(5)
FIGURES = 5
ROUNDS = as_numpy_scalar(3)  # of robust weights
COEFFICIENTS = as_numpy_scalar(6)  # of a quadratic over x and y
STEP_SIGMAS = 3.0
SHARPEST_TURN_RAD = 1.2  # between facets of one narrow cylinder; an edge of a box turns by 1.57
SMOOTH_TURN_RAD = 0.05  # smaller angles are no crease
SMOOTH_SIGMAS = 3.0  # nor are angles below this multiple of the standard deviation of both tilts
SMOOTH_SHARE = 0.8  # least share of each part near the joint surface if no crease separates the parts
SMOOTH_LIMIT = 5.0  # sigmas; largest residual that counts as near in that case
LEAST_SHARE = 0.85  # least share of each part within the trim of the joint surface
UNEVEN_TURN_RAD = 0.25  # between facets of one uneven face
ROUNDING_PX = 4.0  # largest width of a rounded edge
ROUNDING_TURN_RAD = 0.6
ROUNDING_SIGMAS = 2.0
UNEVEN_SHARE = 0.02  # unevenness accepted in a face, as a ratio of the smaller facet's size
LEAST_GAIN = 1e-3  # gain of a merge that is made for another reason than its cost
SCRAP_SHARE = 0.1  # largest size of a fragment or rounded edge, relative to the larger part
PLAIN_MEAN_SQUARE = 1.6  # squared sigmas; limit of the mean square of a part with many independent noise values
MOST_NOISE = 2.5  # largest ratio of observed to modelled variance by which the limits are widened
CREASE_MEAN_SQUARE = 2.0  # if the mean square of a quadratic exceeds the limit by this factor, no surface fits
# Mean square of a rough fit, with residuals cut at five sigmas, above which a full fit cannot reach the limits. GIVE_UP
# is used for two planes or a smooth border; otherwise the threshold is the limit plus SLACK.
GIVE_UP = 10.0
SLACK = 3.0


@compiled
def described(
    kind: int, th: Array, samples: Array, pixels: float, pitch: float, noise: Array, perspective: bool,
) -> tuple[int, Array, Array, Array]:  # fmt: skip
    """Describe a region by the simplest suitable surface; returns its kind, parameters, normals and figures."""
    patches = max(pixels / (1.0 + slow_share_at(noise, np.median(samples[2])) * (SLOW_NOISE_AREA_PX - 1.0)), 1.0)
    kind, th = bend.simplest(kind, th, samples, perspective, patches)
    normals = bend.surface_normals(kind, th, samples, perspective)
    return kind, th, normals, figures_of(kind, th, samples, pixels, patches, pitch, perspective)


@compiled
def figures_of(
    kind: int, th: Array, samples: Array, pixels: float, patches: float, pitch: float, perspective: bool,
) -> Array:  # fmt: skip
    """Return the figures (FIGURES,) of a region.

    The standard deviation of its tilt is that of a plane fitted to noisy values, sigma / (spread sqrt(patches)), with
    the spread of the points in the direction in which it is least.
    """
    out = np.empty(FIGURES)
    out[PIXELS], out[PATCHES] = pixels, patches
    e = bend.residual_sizes(kind, th, samples, perspective)
    out[MEAN_SQUARE] = bend.cut_mean_square(e, fit.TRIM_SIGMAS)
    points = bend.points_of(samples, perspective)
    n = points.shape[0]
    mx, my = np.mean(points[:, 0]), np.mean(points[:, 1])
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(n):
        dx, dy = points[i, 0] - mx, points[i, 1] - my
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    least = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)) / max(n - 1, 1)
    out[TILT] = np.median(samples[3]) / np.sqrt(max(least, 1e-12) * patches)
    out[SIZE_M] = np.sqrt(pixels) * pitch * (np.median(samples[2]) if perspective else 1.0)
    return out


@compiled
def united(
    kind: int, th: Array, samples_a: Array, normals_a: Array, figures_a: Array, samples_b: Array, normals_b: Array,
    figures_b: Array, most: int, pitch: float, perspective: bool,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return samples, normals and figures of the union of two regions, which the surface `kind`, `th` describes.

    Each region contributes an evenly spread choice of its samples, in proportion to its pixels but at least a fifth.
    There are at most `most` samples.
    """
    pixels, patches = figures_a[PIXELS] + figures_b[PIXELS], figures_a[PATCHES] + figures_b[PATCHES]
    share = min(max(figures_b[PIXELS] / pixels, 0.2), 0.8)
    from_a = min(samples_a.shape[1], max(1, round((1.0 - share) * most)))
    from_b = min(samples_b.shape[1], max(1, round(share * most)))
    samples, normals = np.empty((4, from_a + from_b)), np.empty((from_a + from_b, 3))
    _spread(samples_a, normals_a, samples[:, :from_a], normals[:from_a])
    _spread(samples_b, normals_b, samples[:, from_a:], normals[from_a:])
    return samples, normals, figures_of(kind, th, samples, pixels, patches, pitch, perspective)


@compiled
def _spread(samples: Array, normals: Array, few: Array, few_normals: Array) -> None:
    """Fill `few` (4, n) and `few_normals` (n, 3) with an evenly spread choice of samples and normals."""
    n, last = few.shape[1], samples.shape[1] - 1
    step = last / max(n - 1, 1)
    for k in range(n):
        i = last if k == n - 1 and n > 1 else int(k * step)
        for a in range(4):
            few[a, k] = samples[a, i]
        for a in range(3):
            few_normals[k, a] = normals[i, a]


@compiled
def judged(
    kind_a: int, a: Array, samples_a: Array, normals_a: Array, figures_a: Array, kind_b: int, b: Array,
    samples_b: Array, normals_b: Array, figures_b: Array, x: Array, y: Array, length_px: int, noise: Array,
    perspective: bool,
) -> tuple[float, int, Array]:  # fmt: skip
    """Find the best joint surface of two regions that touch at the rays (x, y); returns its gain, kind and parameters.

    The gain is the cost of two surfaces minus that of one; with a gain of 0 or less the regions stay separate.
    `length_px`: number of pixels of their border.
    """
    shown = shown_noise(figures_a, figures_b)
    step, turn = step_and_turn(kind_a, a, kind_b, b, x, y, noise, perspective)
    is_rounding = step <= ROUNDING_SIGMAS * np.sqrt(shown) and turn <= ROUNDING_TURN_RAD
    is_rounding &= _is_strip(figures_a[PIXELS], figures_b[PIXELS], length_px)
    tolerated = max(SMOOTH_TURN_RAD, SMOOTH_SIGMAS * np.hypot(figures_a[TILT], figures_b[TILT]))
    is_smooth = turn < min(tolerated, 0.5 * SHARPEST_TURN_RAD)
    may_join = step <= STEP_SIGMAS * np.sqrt(shown) and turn <= SHARPEST_TURN_RAD
    # A rounded edge is merged with its face in any case, so no fits are needed.
    if may_join and (is_smooth or not is_rounding):
        samples, normals = np.concatenate((samples_a, samples_b), 1), np.concatenate((normals_a, normals_b))
        limit = shown * max(mean_square_limit(figures_a[PATCHES]), mean_square_limit(figures_b[PATCHES]))
        both_flat = kind_a == PLANE and kind_b == PLANE
        is_hopeless = both_flat and _is_creased(samples, perspective, CREASE_MEAN_SQUARE * limit)
        if is_smooth or not is_hopeless:
            give_up = GIVE_UP if both_flat or is_smooth else limit + SLACK
            with_quadric = QUADRIC in (kind_a, kind_b)
            kinds = np.ones(5, np.bool_)
            kinds[QUADRIC] = with_quadric
            own, continued = (kind_a, a) if figures_a[PIXELS] >= figures_b[PIXELS] else (kind_b, b)
            goes_on = own != PLANE and fit.rough_mean_square(own, continued, samples, perspective) <= give_up
            if goes_on:
                # If the surface of the larger region also explains the smaller one, no other kind needs to be tried.
                continued = _continued(own, continued, samples, perspective)
                gain, _ = _gain(
                    own, continued, kind_a, samples_a, figures_a, kind_b, samples_b, figures_b, is_smooth, perspective
                )
                if gain > LEAST_GAIN:
                    return gain, own, continued
                kinds[own] = own == SPHERE and with_quadric  # an ellipsoid starts from a sphere
            correlated = max(samples.shape[1] / (figures_a[PATCHES] + figures_b[PATCHES]), 1.0)
            ths, there = _joint_fits(samples, normals, perspective, kinds, correlated, give_up)
            if both_flat and not there[PLANE]:
                goes_on, continued = True, _continued(PLANE, a, samples, perspective)
            if goes_on:
                ths[own], there[own] = continued, True
            best_kind, best_gain, is_near = _best_fit(
                ths, there, kind_a, samples_a, figures_a, kind_b, samples_b, figures_b, is_smooth, perspective
            )
            if best_gain > 0.0 or is_near:
                return max(best_gain, LEAST_GAIN), best_kind, ths[best_kind].copy()
        if both_flat and turn < UNEVEN_TURN_RAD:
            th = start_plane(bend.points_of(samples, perspective))
            tolerance_m = UNEVEN_SHARE * min(figures_a[SIZE_M], figures_b[SIZE_M])
            if _is_uneven(th, samples_a, samples_b, tolerance_m, perspective):
                return LEAST_GAIN, PLANE, th
    if figures_a[PIXELS] >= figures_b[PIXELS]:
        return _swallowed(is_rounding, kind_a, a, figures_a, kind_b, b, samples_b, figures_b, noise, perspective)
    return _swallowed(is_rounding, kind_b, b, figures_b, kind_a, a, samples_a, figures_a, noise, perspective)


@compiled
def _continued(kind: int, th: Array, samples: Array, perspective: bool) -> Array:
    """Refine the parameters of a surface on the samples of both regions."""
    free = np.zeros(9, np.bool_)
    x, y, z, sigma = samples[0], samples[1], samples[2], samples[3]
    th, _ = fit.fit_robust(kind, th, x, y, z, sigma, perspective, free, ROUNDS)
    return th


@compiled
def _joint_fits(
    samples: Array, normals: Array, perspective: bool, kinds: Mask, correlated: float, give_up: float,
) -> tuple[Array, Mask]:  # fmt: skip
    """Fit each of `kinds` (5,) to the samples of both regions; returns parameters (5, SIZE) and which kinds fit."""
    points = bend.points_of(samples, perspective)
    x, y, z, sigma = samples[0], samples[1], samples[2], samples[3]
    ths, _, kept, score = fit.fit_kinds(
        points, points, normals, x, y, z, sigma, perspective, kinds, correlated, give_up
    )
    return ths, np.isfinite(score) & (kept > 0.5)


@compiled
def _best_fit(
    ths: Array, there: Mask, kind_a: int, samples_a: Array, figures_a: Array, kind_b: int, samples_b: Array,
    figures_b: Array, is_smooth: bool, perspective: bool,
) -> tuple[int, float, bool]:  # fmt: skip
    """Return the kind with the largest gain among those that are `there` (5,), its gain, and whether any lies near.

    The kind is -1 where none is there. `ths` (5, SIZE): joint surface of each kind.
    """
    best_kind, best_gain, is_near = -1, -np.inf, False
    for kind in range(there.shape[0]):
        if there[kind]:
            gain, near = _gain(
                kind, ths[kind], kind_a, samples_a, figures_a, kind_b, samples_b, figures_b, is_smooth, perspective
            )
            is_near |= near
            if gain > best_gain:
                best_kind, best_gain = kind, gain
    return best_kind, best_gain, is_near


@compiled
def _gain(
    kind: int, th: Array, kind_a: int, samples_a: Array, figures_a: Array, kind_b: int, samples_b: Array,
    figures_b: Array, is_smooth: bool, perspective: bool,
) -> tuple[float, bool]:  # fmt: skip
    """Return the cost of two surfaces minus that of the joint surface; minus infinity if it does not describe both.

    Also returns whether the regions meet without a crease and lie near the joint surface. They are then merged
    regardless of the cost.
    """
    shown = shown_noise(figures_a, figures_b)
    patches_a, patches_b = figures_a[PATCHES], figures_b[PATCHES]
    apart = bend.schwarz_price(kind_a, patches_a) + bend.schwarz_price(kind_b, patches_b)
    together = bend.schwarz_price(kind, patches_a + patches_b)
    fits, near = True, is_smooth
    for side in range(2):
        samples, figures = (samples_a, figures_a) if side == 0 else (samples_b, figures_b)
        e = bend.residual_sizes(kind, th, samples, perspective)
        mean2 = bend.cut_mean_square(e, fit.TRIM_SIGMAS)
        fits &= mean2 <= shown * mean_square_limit(figures[PATCHES]) and bool(
            np.mean(e < fit.TRIM_SIGMAS) >= LEAST_SHARE
        )
        near &= bool(np.mean(e < SMOOTH_LIMIT) > SMOOTH_SHARE)
        apart += figures[MEAN_SQUARE] * figures[PATCHES] / shown
        together += mean2 * figures[PATCHES] / shown
    return apart - together if fits or near else -np.inf, near


@compiled
def _is_strip(pixels_a: float, pixels_b: float, length_px: int) -> bool:
    """Return whether the smaller region is a narrow strip along its border with a much larger one."""
    less = min(pixels_a, pixels_b)
    return less < ROUNDING_PX * length_px and less < SCRAP_SHARE * max(pixels_a, pixels_b)


@compiled
def _is_uneven(th: Array, samples_a: Array, samples_b: Array, tolerance_m: float, perspective: bool) -> bool:
    """Return whether most of two facets lies within `tolerance_m` of the plane `th`, as uneven upholstery or cardboard does."""
    for side in range(2):
        samples = samples_a if side == 0 else samples_b
        e = bend.residual_sizes(PLANE, th, samples, perspective) * samples[3]
        if not np.mean(e < tolerance_m) > SMOOTH_SHARE:
            return False
    return True


@compiled
def _swallowed(
    is_rounding: bool, kind: int, th: Array, figures: Array, own_kind: int, own: Array, samples: Array,
    own_figures: Array, noise: Array, perspective: bool,
) -> tuple[float, int, Array]:  # fmt: skip
    """Return the gain of merging a rounded edge or a fragment (`own`) into the larger region, and the latter's surface."""
    if is_rounding:
        return LEAST_GAIN, kind, th
    if own_figures[PIXELS] > SCRAP_SHARE * figures[PIXELS]:
        return 0.0, kind, th
    return bend.scrap_gain(kind, th, own_kind, own, samples, own_figures[PIXELS], noise, perspective), kind, th


@compiled
def _is_creased(samples: Array, perspective: bool, limit: float) -> bool:
    """Return whether the mean squared residual of a quadratic in x and y exceeds `limit` squared sigmas per sample.

    A quadratic follows any smooth surface that turns by at most `SHARPEST_TURN_RAD`. If it fails, no joint surface
    needs to be fitted.
    """
    n = samples.shape[1]
    A, b, row = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    mx, my = np.mean(samples[0]), np.mean(samples[1])
    scale = 1.0 / max(np.std(samples[0]), np.std(samples[1]), 1e-12)
    g0 = 1.0 / samples[2, 0] if perspective else samples[2, 0]
    total = 0.0
    for i in range(n):
        u, v, z = (samples[0, i] - mx) * scale, (samples[1, i] - my) * scale, samples[2, i]
        row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, u, v, u * u, u * v, v * v
        # Under perspective planes are linear in 1 / z, and sigma is converted accordingly.
        value = (1.0 / z if perspective else z) - g0
        sigma = samples[3, i] / (z * z) if perspective else samples[3, i]
        w = 1.0 / (sigma * sigma)
        total += w * value * value
        for j in range(6):
            b[j] += w * row[j] * value
            for k in range(j + 1):
                A[j, k] += w * row[j] * row[k]
    for j in range(6):
        for k in range(j):
            A[k, j] = A[j, k]
    x = b.copy()
    if not solve_positive(A, x, COEFFICIENTS):
        return False
    for j in range(6):
        total -= x[j] * b[j]
    return bool(total > limit * max(n - 6, 1))


@compiled
def shown_noise(figures_a: Array, figures_b: Array) -> float:
    """Return the ratio of observed to modelled variance of two regions, from 1 to `MOST_NOISE`.

    It exceeds 1 on slanted faces, for example, where depth scatters more than the noise model says.
    """
    na, nb = figures_a[PATCHES], figures_b[PATCHES]
    shown = (figures_a[MEAN_SQUARE] * na + figures_b[MEAN_SQUARE] * nb) / (na + nb)
    return float(min(max(1.0, shown), MOST_NOISE))


@compiled
def mean_square_limit(patches: float) -> float:
    """Return the limit 1 + 2 sqrt(2 / n) of the mean square of n residuals, but at least `PLAIN_MEAN_SQUARE`.

    A correct surface meets it with probability 0.97, because the mean square has the standard deviation sqrt(2 / n).
    """
    return float(max(PLAIN_MEAN_SQUARE, 1.0 + 2.0 * np.sqrt(2.0 / patches)))
