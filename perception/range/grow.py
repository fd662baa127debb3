"""Growing surfaces over the grid: planes from flat seeds, curved surfaces from a fitted start.

A region grows while its own model explains the next block, so it stops at a crease however gentle the normals change
there. A plane that grew on a curved surface betrays itself: a quadratic explains its support clearly better.
"""

# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.starts import solve_positive
from perception.range.surfaces import LEAN, PLANE, depth_on, normal_on

GROW_SIGMAS = 3.0
CURVED_RMS = 0.4  # in sigmas: how much a quadratic may gain over a plane before the plane is a strip of something bent
CURVED_F = 4.0  # and how significant that gain must be (F ratio)
SEED_LEVELS = 64
LONE_BEND = 0.02
SWEEPS = 3  # of growing a plane from one seed, each with the plane of the sweep before
SAME_BLOCKS = 200  # of which no more than one may come or go in a sweep that is the last
MOST_PLANES = 512
STEADY_RMS = 1.8  # what a tangent plane leaves over in sigmas, up to which its normal counts
LOOSE_NORMAL = 0.5  # length of a normal that seeds a plane but does not count
TAKEN = np.int32(2**31 - 1)


@njit(cache=True, error_model="numpy")
def seed_order(normal, rms, free, reach):  # type: ignore[no-untyped-def]  # numba types it
    """Free blocks with a tangent plane, flattest neighbourhood first (counting sort), as flat indices."""
    h, w = rms.shape
    normals, known = _framed_normals(normal, rms, free, reach)
    cosine, bend, levels = np.empty(w), np.empty(w), np.empty((h, w), np.int32)
    starts = np.zeros(SEED_LEVELS + 1, np.int64)
    for r in range(h):
        if not known[r]:
            continue
        bend[:] = 0.0
        for i, j in ((2 * reach, reach), (0, reach), (reach, 2 * reach), (reach, 0)):
            cosine[:] = 0.0
            for k in range(3):
                _add_product(normals[k, r + reach, reach : reach + w], normals[k, r + i, j : j + w], cosine)
            _add_bend(cosine, bend)
        _fill_levels(bend, rms[r], normals[0, r + reach, reach : reach + w], levels[r])
        for c in range(w):
            if levels[r, c] >= 0:
                starts[levels[r, c] + 1] += 1
    for k in range(SEED_LEVELS):
        starts[k + 1] += starts[k]
    out = np.empty(starts[SEED_LEVELS], np.int32)
    for r in range(h):
        for c in range(w if known[r] else 0):
            level = levels[r, c]
            if level >= 0:
                out[starts[level]] = r * w + c
                starts[level] += 1
    return out


@njit(cache=True, error_model="numpy")
def _framed_normals(normal, rms, free, reach):  # type: ignore[no-untyped-def]  # numba types it
    """(3, h + 2 reach, w + 2 reach) components, NaN where a block has no normal, as all around; and which rows have any."""
    h, w = rms.shape
    out, known = np.full((3, h + 2 * reach, w + 2 * reach), np.nan), np.zeros(h, np.bool_)
    for r in range(h):
        for c in range(w):
            if free[r, c] and np.isfinite(rms[r, c]):
                known[r] = True
                for k in range(3):
                    out[k, r + reach, c + reach] = normal[r, c, k]
    return out, known


@njit(cache=True, error_model="numpy", **LEAN)
def _add_product(a, b, out):  # type: ignore[no-untyped-def]  # numba types it
    for c in range(out.shape[0]):
        out[c] += a[c] * b[c]


@njit(cache=True, error_model="numpy", **LEAN)
def _add_bend(cosine, bend):  # type: ignore[no-untyped-def]  # numba types it
    """How far a normal turns to a neighbour: 1 less the cosine; a neighbour that is missing (NaN) says little."""
    for c in range(bend.shape[0]):
        bend[c] += 1.0 - cosine[c] if cosine[c] == cosine[c] else LONE_BEND


@njit(cache=True, error_model="numpy", **LEAN)
def _fill_levels(bend, rms, known, levels):  # type: ignore[no-untyped-def]  # numba types it
    """Level of each block, from 0 for a flat and quiet neighbourhood; -1 for a block without a normal."""
    for c in range(bend.shape[0]):
        level = min(SEED_LEVELS - 1.0, 12.0 * np.sqrt(max(25.0 * bend[c], 0.0)) + 4.0 * max(rms[c] - 1.0, 0.0))
        levels[c] = np.int32(level if known[c] == known[c] else -1.0)


@njit(cache=True, **LEAN)
def solve3(S, out):  # type: ignore[no-untyped-def]  # numba types it
    """Coefficients (a, b, c) of g = a x + b y + c from sums (n, x, y, xx, xy, yy, g, xg, yg); False if degenerate."""
    n = S[0]
    if n <= 0.0:
        return False
    mx, my, mg = S[1] / n, S[2] / n, S[6] / n
    sxx, sxy, syy = S[3] / n - mx * mx, S[4] / n - mx * my, S[5] / n - my * my
    sxg, syg = S[7] / n - mx * mg, S[8] / n - my * mg
    det = sxx * syy - sxy * sxy
    if det <= 1e-6 * sxx * syy or det <= 0.0:
        return False
    out[0] = (syy * sxg - sxy * syg) / det
    out[1] = (sxx * syg - sxy * sxg) / det
    out[2] = mg - out[0] * mx - out[1] * my
    return True


@njit(cache=True, **LEAN)
def plane_from_coefficients(m, perspective, th):  # type: ignore[no-untyped-def]  # numba types it
    """PLANE parameters, normal towards the sensor, from g = a x + b y + c."""
    if perspective:
        nx, ny, nz, d = m[0], m[1], m[2], 1.0  # (a, b, c) . X = 1 and z > 0: this normal points away
    else:
        nx, ny, nz, d = -m[0], -m[1], 1.0, m[2]
    length = -np.sqrt(nx * nx + ny * ny + nz * nz)
    th[0], th[1], th[2], th[3] = nx / length, ny / length, nz / length, d / length


@njit(cache=True)
def _quadratic_gain(idx, count, table, x0, y0, scale):  # type: ignore[no-untyped-def]  # numba types it
    """Sum of squares (in sigmas) left by a plane and by a quadratic over the blocks idx[:count] of a padded table."""
    A, b, row = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    total = 0.0
    g0 = table[idx[0], 2]
    inverse = 1.0 / scale
    for k in range(count):
        i = idx[k]
        px, py = (table[i, 0] - x0) * inverse, (table[i, 1] - y0) * inverse
        row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, px, py, px * px, px * py, py * py
        w, value = table[i, 3], table[i, 2] - g0
        total += w * value * value
        for a in range(6):
            b[a] += w * row[a] * value
            for e in range(a + 1):
                A[a, e] += w * row[a] * row[e]
    for a in range(6):
        for e in range(a):
            A[e, a] = A[a, e]
        A[a, a] *= 1.0 + 1e-9
    plane, full = b[:3].copy(), b.copy()
    if not solve_positive(A[:3, :3].copy(), plane, 3):
        return max(total, 0.0), max(total, 0.0)
    left = max(total - plane @ b[:3], 0.0)
    if not solve_positive(A, full, 6):
        return left, left
    return left, max(total - full @ b, 0.0)


@njit(cache=True)
def grow_planes(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, sigma, normal, rms, free, label, first_label, perspective, order, least, cos_limit, tried
):
    """Planes over the free blocks; writes labels and returns parameters (M, 16), block counts (M,), mean squares (M,).

    Blocks of supports that turned out curved are marked in `tried` so that they seed nothing again.
    """
    h, w = z.shape
    table, mark, across = _padded(x, y, z, sigma, normal, rms, free, perspective)
    ff, fl, ft = free.ravel(), label.ravel(), tried.ravel()
    queue = np.empty(h * w, np.int32)
    ths, counts, mean2 = np.zeros((MOST_PLANES, 16)), np.zeros(MOST_PLANES, np.int64), np.zeros(MOST_PLANES)
    found = 0
    stamp = 0
    m, S, th = np.zeros(3), np.zeros(9), np.zeros(16)
    for o in range(order.shape[0]):
        seed = order[o]
        if not ff[seed] or ft[seed] or found == MOST_PLANES:
            continue
        start = (seed // w + 1) * across + seed % w + 1
        if not _tangent(table[start], perspective, m):
            continue
        count = 0
        for sweep in range(SWEEPS):
            plane_from_coefficients(m, perspective, th)
            before = count
            stamp += 1
            count = _grown(table, mark, across, start, stamp, sweep, m, th, perspective, cos_limit, queue, S)
            if count < least or not solve3(S, m):
                count = 0
                break
            if sweep > 0 and abs(count - before) * SAME_BLOCKS < count:
                break
        if count == 0:
            ft[seed] = True
            continue
        plane_from_coefficients(m, perspective, th)
        x0, y0 = S[1] / S[0], S[2] / S[0]
        scale = np.sqrt(max(S[3] / S[0] - x0 * x0 + S[5] / S[0] - y0 * y0, 1e-30))
        flat, bent = _quadratic_gain(queue, count, table, x0, y0, scale)
        gain = (flat - bent) / 3.0
        ratio = gain / max(bent / max(count - 6, 1), 0.3)
        is_bent = (flat - bent > CURVED_RMS * CURVED_RMS * count and ratio > CURVED_F) or flat > 3.0 * count
        for k in range(count):
            i = queue[k]
            at = (i // across - 1) * w + i % across - 1
            if is_bent:
                ft[at] = True
                continue
            ff[at] = False
            fl[at] = first_label + found
            mark[i] = TAKEN
        if is_bent:
            continue
        ths[found] = th
        counts[found] = count
        mean2[found] = flat / max(count - 3, 1)
        found += 1
    return ths[:found].copy(), counts[:found].copy(), mean2[:found].copy()


@njit(cache=True, error_model="numpy")
def _padded(x, y, z, sigma, normal, rms, free, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """Blocks with a frame of taken ones around, one row of numbers each, so that growing needs no look at the rim.

    Returns (N, 8) x, y, g, its weight, normal (0 where it says nothing), z; marks (N,), `TAKEN` where a block is not
    free; and the number of blocks across.
    """
    h, w = z.shape
    across = w + 2
    table, mark = np.zeros(((h + 2) * across, 8)), np.full((h + 2) * across, TAKEN, np.int32)
    for r in range(h):
        for c in range(w):
            if not free[r, c]:
                continue
            i = (r + 1) * across + c + 1
            d = z[r, c]
            s = sigma[r, c] / (d * d) if perspective else sigma[r, c]
            mark[i] = 0
            table[i, 0], table[i, 1], table[i, 2] = x[r, c], y[r, c], 1.0 / d if perspective else d
            table[i, 3], table[i, 7] = 1.0 / (s * s), d
            if np.isfinite(rms[r, c]):
                # The length of the normal says whether it counts: noisy ones do not hold a plane back.
                size = 1.0 if rms[r, c] < STEADY_RMS else LOOSE_NORMAL
                for k in range(3):
                    table[i, 4 + k] = size * normal[r, c, k]
    return table, mark, across


@njit(cache=True, error_model="numpy", **LEAN)
def _tangent(block, perspective, m):  # type: ignore[no-untyped-def]  # numba types it
    """Coefficients of the tangent plane of one row of the table into `m`; False where its ray grazes it."""
    x, y, nx, ny, nz = block[0], block[1], block[4], block[5], block[6]
    if perspective:
        d = (nx * x + ny * y + nz) * block[7]
        if abs(d) < 1e-9 * (abs(nx) + abs(ny) + abs(nz)):
            return False
        m[0], m[1], m[2] = nx / d, ny / d, nz / d
        return True
    m[0], m[1] = -nx / nz, -ny / nz
    m[2] = block[2] - m[0] * x - m[1] * y
    return True


@njit(cache=True, error_model="numpy", **LEAN)
def _grown(table, mark, across, seed, stamp, sweep, m, th, perspective, cos_limit, queue, S):  # type: ignore[no-untyped-def]  # numba types it
    """Blocks connected to `seed` that the plane g = m . (x, y, 1) explains, into `queue`; returns how many.

    `S` receives their sums as `solve3` reads them. In the first sweep the plane follows the blocks as they come.
    """
    S[:] = 0.0
    queue[0] = seed
    mark[seed] = stamp
    count, head, refit_at = 1, 0, 8
    a, b, c = m[0], m[1], m[2]
    limit = GROW_SIGMAS * GROW_SIGMAS
    while head < count:
        i = queue[head]
        head += 1
        x, y, g, weight = table[i, 0], table[i, 1], table[i, 2], table[i, 3]
        wx, wy = weight * x, weight * y
        S[0] += weight
        S[1] += wx
        S[2] += wy
        S[3] += wx * x
        S[4] += wx * y
        S[5] += wy * y
        S[6] += weight * g
        S[7] += wx * g
        S[8] += wy * g
        if sweep == 0:
            if head == refit_at:
                refit_at *= 2
                if solve3(S, m):
                    plane_from_coefficients(m, perspective, th)
                    a, b, c = m[0], m[1], m[2]
            limit = (GROW_SIGMAS + 2.0 / np.sqrt(head)) ** 2
        for side in range(4):
            j = i + (across if side == 0 else -across if side == 1 else 1 if side == 2 else -1)
            if mark[j] >= stamp:
                continue
            e = table[j, 2] - a * table[j, 0] - b * table[j, 1] - c
            if not e * e * table[j, 3] <= limit:
                continue
            nx, ny, nz = table[j, 4], table[j, 5], table[j, 6]
            turn = th[0] * nx + th[1] * ny + th[2] * nz
            if turn < cos_limit and nx * nx + ny * ny + nz * nz > 0.5:
                continue
            mark[j] = stamp
            queue[count] = j
            count += 1
    return count


@njit(cache=True)
def grow_surface(  # type: ignore[no-untyped-def]  # numba types it
    kind, th, x, y, z, sigma, normal, rms, free, seeds, perspective, cos_limit, mark, stamp, queue
):
    """Blocks connected to `seeds` that the surface explains; returns their number, indices in queue[:number].

    Also returns the sum of squared residuals. `mark` receives `stamp` where a block belongs.
    """
    h, w = z.shape
    fx, fy, fz, fs = x.ravel(), y.ravel(), z.ravel(), sigma.ravel()
    ff, fr = free.ravel(), rms.ravel()
    fn = normal.reshape(h * w, 3)
    count, head, total = 0, 0, 0.0
    for k in range(seeds.shape[0]):
        j = seeds[k]
        e2 = _explained(kind, th, fx[j], fy[j], fz[j], fs[j], fn, j, fr[j], perspective, cos_limit)
        if ff[j] and e2 >= 0.0 and mark[j] != stamp:
            mark[j] = stamp
            queue[count] = j
            count += 1
            total += e2
    while head < count:
        i = queue[head]
        head += 1
        r, c = i // w, i % w
        for s in range(4):
            rr = r + (1 if s == 0 else -1 if s == 1 else 0)
            cc = c + (1 if s == 2 else -1 if s == 3 else 0)
            if rr < 0 or cc < 0 or rr >= h or cc >= w:
                continue
            j = rr * w + cc
            if mark[j] == stamp or not ff[j]:
                continue
            e2 = _explained(kind, th, fx[j], fy[j], fz[j], fs[j], fn, j, fr[j], perspective, cos_limit)
            if e2 < 0.0:
                continue
            mark[j] = stamp
            queue[count] = j
            count += 1
            total += e2
    return count, total


@njit(cache=True, **LEAN)
def _explained(kind, th, x, y, z, sigma, normals, j, rms, perspective, cos_limit):  # type: ignore[no-untyped-def]  # numba types it
    """Squared residual in sigmas (eased where grazing) if the surface explains the block, whose normal is the j-th, else -1."""
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return -1.0
    e = (z - zm) / sigma
    px, py = (x * zm, y * zm) if perspective else (x, y)
    nx, ny, nz = normal_on(kind, th, px, py, zm)
    facing = nx * x + ny * y + nz if perspective else nz
    reach = np.sqrt(x * x + y * y + 1.0) if perspective else 1.0
    # The block's own sampling error grows with the slope; at the rim of a curved surface it rules.
    limit = GROW_SIGMAS * min(3.0, max(1.0, 0.5 * reach / max(abs(facing), 1e-3)))
    if abs(e) > limit:
        return -1.0
    if rms < 1.8 and kind != PLANE:
        turn = nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]
        if facing > 0.0:
            turn = -turn
        if turn < cos_limit:
            return -1.0
    e *= GROW_SIGMAS / limit
    return e * e


@njit(cache=True)
def smooth_links(z, sigma, free, slope, inverse_f, perspective, normal, rms, cos_limit):  # type: ignore[no-untyped-def]  # numba types it
    """Which free blocks belong with their right and lower neighbour: a small depth step and a small turn between."""
    h, w = z.shape
    right, down = np.zeros((h, w), np.bool_), np.zeros((h, w), np.bool_)
    for r in range(h):
        for c in range(w):
            if not free[r, c]:
                continue
            limit = slope * (z[r, c] if perspective else 1.0) * inverse_f + 4.0 * sigma[r, c]
            for s in range(2):
                i, j = r + s, c + 1 - s
                if i >= h or j >= w or not free[i, j] or not abs(z[i, j] - z[r, c]) <= limit:
                    continue
                if rms[r, c] < 1.8 and rms[i, j] < 1.8:
                    dot = 0.0
                    for k in range(3):
                        dot += normal[r, c, k] * normal[i, j, k]
                    if dot < cos_limit:
                        continue
                if s == 0:
                    right[r, c] = True
                else:
                    down[r, c] = True
    return right, down
