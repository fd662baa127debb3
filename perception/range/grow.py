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
SAME_PLANE = 0.1  # sigmas: a plane that moves less explains the same blocks
MOST_PLANES = 512
STEADY_RMS = 1.8  # what a tangent plane leaves over in sigmas, up to which its normal counts
LOOSE_NORMAL = 0.5  # length of a normal that seeds a plane but does not count
TAKEN = np.int32(2**31 - 1)
BENT = np.int32(-1)  # a block whose support is no plane
# Where the products of 1, p, q, pp, pq, qq stand among 1, p, q, pp, pq, qq, ppp, ppq, pqq, qqq, pppp, pppq, ppqq, pqqq, qqqq.
MOMENTS = np.array(
    [
        [0, 1, 2, 3, 4, 5],
        [1, 3, 4, 6, 7, 8],
        [2, 4, 5, 7, 8, 9],
        [3, 6, 7, 10, 11, 12],
        [4, 7, 8, 11, 12, 13],
        [5, 8, 9, 12, 13, 14],
    ]
)


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


@njit(cache=True, error_model="numpy")
def _quadratic_gain(idx, count, table, x0, y0, scale):  # type: ignore[no-untyped-def]  # numba types it
    """Sum of squares (in sigmas) left by a plane and by a quadratic over the blocks idx[:count] of a padded table."""
    M, b, total = np.zeros(15), np.zeros(6), 0.0
    g0, per = table[idx[0], 2], 1.0 / scale
    for k in range(count):
        i = idx[k]
        p, q, v, w = (table[i, 0] - x0) * per, (table[i, 1] - y0) * per, table[i, 2] - g0, table[i, 3]
        pp, pq, qq, wv = p * p, p * q, q * q, w * v
        wpp, wpq, wqq = w * pp, w * pq, w * qq
        total += wv * v
        for m, value in enumerate((w, w * p, w * q, wpp, wpq, wqq, wpp * p, wpp * q, wqq * p, wqq * q)):
            M[m] += value
        for m, value in enumerate((wpp * pp, wpp * pq, wpp * qq, wpq * qq, wqq * qq)):
            M[10 + m] += value
        for m, value in enumerate((wv, wv * p, wv * q, wv * pp, wv * pq, wv * qq)):
            b[m] += value
    A = np.empty((6, 6))
    # Products of two of 1, p, q, pp, pq, qq, by where their moment stands.
    for a, row in enumerate(MOMENTS):
        for e in range(6):
            A[a, e] = M[row[e]] * (1.0 + 1e-9 if a == e else 1.0)
    plane, full = b[:3].copy(), b.copy()
    if not solve_positive(A[:3, :3].copy(), plane, 3):
        return max(total, 0.0), max(total, 0.0)
    left = max(total - plane @ b[:3], 0.0)
    if not solve_positive(A, full, 6):
        return left, left
    return left, max(total - full @ b, 0.0)


@njit(cache=True, error_model="numpy")
def grow_planes(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, sigma, normal, rms, free, label, first_label, perspective, order, least, cos_limit, tried
):
    """Planes over the free blocks; writes labels and returns parameters (M, 16), block counts (M,), mean squares (M,).

    Blocks of supports that turned out curved are marked in `tried` so that they seed nothing again.
    """
    h, w = z.shape
    table, mark, place = _padded(x, y, z, sigma, normal, rms, free, perspective)
    across = w + 2
    owner = np.zeros(table.shape[0], np.int32)  # label, or BENT
    queue, spans = np.empty(h * w, np.int32), np.empty((h * w, 2), np.int32)
    ths, counts, mean2 = np.zeros((MOST_PLANES, 16)), np.zeros(MOST_PLANES, np.int64), np.zeros(MOST_PLANES)
    found, stamp = 0, 0
    m, S, th = np.zeros(3), np.zeros(9), np.zeros(16)
    for o in range(order.shape[0]):
        start = place[order[o]]
        if mark[start] == TAKEN or owner[start] != 0 or found == MOST_PLANES:
            continue
        if not _tangent(table[start], perspective, m):
            continue
        count = 0
        for sweep in range(SWEEPS):
            plane_from_coefficients(m, perspective, th)
            before, a, b, c = count, m[0], m[1], m[2]
            stamp += 2
            if sweep == 0:
                count = _grown(table, mark, across, start, stamp, m, th, perspective, cos_limit, queue, S)
            else:
                count = _filled(table, mark, across, start, stamp, m, th, cos_limit, queue, spans, S)
            if count < least or not solve3(S, m):
                count = 0
                break
            is_same = abs(count - before) * SAME_BLOCKS < count
            if sweep > 0 and (is_same or _shift(m[0] - a, m[1] - b, m[2] - c, S, count) < SAME_PLANE):
                break
        if count == 0:
            owner[start] = BENT
            continue
        plane_from_coefficients(m, perspective, th)
        x0, y0 = S[1] / S[0], S[2] / S[0]
        scale = np.sqrt(max(S[3] / S[0] - x0 * x0 + S[5] / S[0] - y0 * y0, 1e-30))
        flat, bent = _quadratic_gain(queue, count, table, x0, y0, scale)
        gain = (flat - bent) / 3.0
        ratio = gain / max(bent / max(count - 6, 1), 0.3)
        is_bent = (flat - bent > CURVED_RMS * CURVED_RMS * count and ratio > CURVED_F) or flat > 3.0 * count
        for k in range(count):
            owner[queue[k]] = BENT if is_bent else first_label + found
        if is_bent:
            continue
        for k in range(count):
            mark[queue[k]] = TAKEN
        ths[found] = th
        counts[found] = count
        mean2[found] = flat / max(count - 3, 1)
        found += 1
    _hand_over(owner, place, free.ravel(), label.ravel(), tried.ravel())
    return ths[:found].copy(), counts[:found].copy(), mean2[:found].copy()


@njit(cache=True, error_model="numpy", **LEAN)
def _shift(a, b, c, S, count):  # type: ignore[no-untyped-def]  # numba types it
    """Root mean square of a x + b y + c over `count` blocks of sums `S`, in sigmas."""
    n, x, y = S[0], S[1] / S[0], S[2] / S[0]
    xx, xy, yy = S[3] / n - x * x, S[4] / n - x * y, S[5] / n - y * y
    square = (a * x + b * y + c) ** 2 + a * a * xx + 2.0 * a * b * xy + b * b * yy
    return np.sqrt(max(square, 0.0) * n / count)


@njit(cache=True, error_model="numpy", **LEAN)
def _hand_over(owner, place, free, label, tried):  # type: ignore[no-untyped-def]  # numba types it
    for i in range(place.shape[0]):
        mine = owner[place[i]]
        if mine > 0:
            label[i], free[i] = mine, False
        elif mine == BENT:
            tried[i] = True


@njit(cache=True, error_model="numpy")
def _padded(x, y, z, sigma, normal, rms, free, perspective):  # type: ignore[no-untyped-def]  # numba types it
    """Blocks with a frame of taken ones around, one row of numbers each, so that growing needs no look at the rim.

    Returns (N, 8) x, y, g, its weight, normal (0 where it says nothing), z; marks (N,), `TAKEN` where a block is not
    free; and where among the N each block stands (h w,).
    """
    h, w = z.shape
    across = w + 2
    table, mark = np.zeros(((h + 2) * across, 8)), np.full((h + 2) * across, TAKEN, np.int32)
    place = np.empty(h * w, np.int32)
    for r in range(h):
        for c in range(w):
            i = (r + 1) * across + c + 1
            place[r * w + c] = i
            if not free[r, c]:
                continue
            d = z[r, c]
            weight = (d * d if perspective else 1.0) / sigma[r, c]
            mark[i] = 0
            table[i, 0], table[i, 1], table[i, 2] = x[r, c], y[r, c], 1.0 / d if perspective else d
            table[i, 3], table[i, 7] = weight * weight, d
            if np.isfinite(rms[r, c]):
                # The length of the normal says whether it counts: noisy ones do not hold a plane back.
                size = 1.0 if rms[r, c] < STEADY_RMS else LOOSE_NORMAL
                for k in range(3):
                    table[i, 4 + k] = size * normal[r, c, k]
    return table, mark, place


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
def _add_block(block, S):  # type: ignore[no-untyped-def]  # numba types it
    """One more row of the table into the sums that `solve3` reads."""
    x, y, g, weight = block[0], block[1], block[2], block[3]
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


@njit(cache=True, error_model="numpy", **LEAN)
def _fits(block, a, b, c, th, limit, cos_limit):  # type: ignore[no-untyped-def]  # numba types it
    """Whether the plane g = a x + b y + c, `th`, explains a row of the table, and its normal does not speak against it."""
    e = block[2] - a * block[0] - b * block[1] - c
    nx, ny, nz = block[4], block[5], block[6]
    turn = th[0] * nx + th[1] * ny + th[2] * nz
    return e * e * block[3] <= limit and (turn >= cos_limit or nx * nx + ny * ny + nz * nz <= 0.5)


@njit(cache=True, error_model="numpy", **LEAN)
def _grown(table, mark, across, seed, stamp, m, th, perspective, cos_limit, queue, S):  # type: ignore[no-untyped-def]  # numba types it
    """Blocks connected to `seed` that the plane explains, nearest first, into `queue`; returns how many.

    The plane g = m . (x, y, 1) follows the blocks as they come: they must come from all sides.
    `S` receives their sums as `solve3` reads them.
    """
    S[:] = 0.0
    queue[0] = seed
    mark[seed] = stamp
    count, head, refit_at = 1, 0, 8
    a, b, c = m[0], m[1], m[2]
    while head < count:
        i = queue[head]
        head += 1
        _add_block(table[i], S)
        if head == refit_at:
            refit_at *= 2
            if solve3(S, m):
                plane_from_coefficients(m, perspective, th)
                a, b, c = m[0], m[1], m[2]
        limit = (GROW_SIGMAS + 2.0 / np.sqrt(head)) ** 2
        for side in range(4):
            j = i + (across if side == 0 else -across if side == 1 else 1 if side == 2 else -1)
            if mark[j] < stamp and _fits(table[j], a, b, c, th, limit, cos_limit):
                mark[j] = stamp
                queue[count] = j
                count += 1
    return count


@njit(cache=True, error_model="numpy", **LEAN)
def _filled(table, mark, across, seed, stamp, m, th, cos_limit, queue, spans, S):  # type: ignore[no-untyped-def]  # numba types it
    """All blocks connected to `seed` that the plane g = m . (x, y, 1) explains, a span of a row at a time.

    As `_grown`, with the plane held. Blocks that it does not explain are marked `stamp` - 1, so that none is asked twice.
    """
    S[:] = 0.0
    mark[seed] = stamp
    count = _span(table, mark, seed, stamp, m, th, cos_limit, queue, 0, spans[0], S)
    found, head = 1, 0
    while head < found:
        left, right = spans[head]
        head += 1
        for step in (-across, across):
            j, end = left + step, right + step
            while j < end:
                if mark[j] < stamp - 1:
                    if _fits(table[j], m[0], m[1], m[2], th, GROW_SIGMAS * GROW_SIGMAS, cos_limit):
                        mark[j] = stamp
                        count = _span(table, mark, j, stamp, m, th, cos_limit, queue, count, spans[found], S)
                        j = spans[found, 1]
                        found += 1
                    else:
                        mark[j] = stamp - 1
                j += 1
    return count


@njit(cache=True, error_model="numpy", **LEAN)
def _span(table, mark, at, stamp, m, th, cos_limit, queue, count, span, S):  # type: ignore[no-untyped-def]  # numba types it
    """The blocks of one row that join the one at `at` on both sides, into `queue`, their ends [first, last) into `span`."""
    a, b, c, limit = m[0], m[1], m[2], GROW_SIGMAS * GROW_SIGMAS
    for step in (-1, 1):
        j = at + step
        while mark[j] < stamp - 1:
            fits = _fits(table[j], a, b, c, th, limit, cos_limit)
            mark[j] = stamp if fits else stamp - 1
            if not fits:
                break
            j += step
        span[0 if step < 0 else 1] = j
    span[0] += 1
    for i in range(span[0], span[1]):
        queue[count] = i
        count += 1
        _add_block(table[i], S)
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
