# ruff: noqa: PLR0912 - a compiled loop keeps one equation in one place
# mypy: disallow-untyped-defs=False
"""Compiled search of the four-light pose: every local minimum, the profile over the normal, the mirror's share.

Conventions as in `quadrangle_cost`.
"""

from __future__ import annotations

import numpy as np

from perception.vision.quadrangle_cost import chi_square, expand, minimise, rotation_of, solve_damped, turn_onto
from perception.vision.quadrangle_jit import back3, cross3, dot3, jit, mix3, product3, put1, put2, times3, unit3
from perception.vision.quadrangle_p3p import cofactors, real_cubic_root, three_point

MIRROR_TURN_COS = 0.99619469809  # 5 degrees: normals nearer than this are one pose, not two
RING_STEP_RAD = 0.10471975512  # 6 degrees; 2.5 degrees gave the same mass (correlation 0.999, 8000 problems)
RING_COUNT = 12  # azimuths; 24 gave the same
RING_END_RAD = 1.308996939  # 75 degrees
WORTHLESS = 60.0  # chi-square above the best at which a minimum has odds of 1 in 1e13


@jit
def rotation_distance(A, B):
    """1 - cos of the angle between two rotations, doubled: 3 - trace(A^T B)."""
    s = 3.0
    for i in range(3):
        for j in range(3):
            s -= A[i, j] * B[i, j]
    return s


@jit
def ordered_seeds(X, f, m, A, Rs, ts, costs):
    """Three-point poses of the four triples with their chi-square over all four points; returns how many.

    Rs (16, 3, 3), ts (16, 3), costs (16,) are filled.
    """
    P, F = np.empty((3, 3)), np.empty((3, 3))
    count = 0
    for left_out in range(4):
        n = 0
        for i in range(4):
            if i != left_out:
                put1(P[n], X[i])
                put1(F[n], f[i])
                n += 1
        side1, side2 = mix3(1.0, P[1], -1.0, P[0]), mix3(1.0, P[2], -1.0, P[0])
        area = cross3(side1, side2)
        size = dot3(side1, side1) + dot3(side2, side2)
        if dot3(area, area) < 1e-8 * size * size:
            continue
        found = three_point(P, F, Rs[count:], ts[count:])
        for k in range(count, count + found):
            costs[k] = chi_square(Rs[k], ts[k], X, m, A)
        count += found
    return count


@jit
def mirrored(R, t, normal):
    """R with the normal (object axes) reflected about the line of sight through the centroid."""
    n = times3(R, normal)
    k = unit3(t)
    reflected = mix3(2.0 * dot3(n, k), k, -1.0, n)
    if dot3(n, reflected) < -0.999999:
        return R
    return product3(turn_onto(n, reflected), R)


@jit
def all_minima(X, m, A, normal, Rs, ts, costs, Ns):
    """Distinct local minima of chi-square, lowest first, into Rs (M,3,3), ts, costs, Ns (M,6,6); returns how many.

    Starts: the best three-point pose, the mirror of its minimum, then every three-point pose far from these.
    """
    f = np.empty((4, 3))
    for i in range(4):
        norm = np.sqrt(m[i, 0] ** 2 + m[i, 1] ** 2 + 1.0)
        f[i, 0], f[i, 1], f[i, 2] = m[i, 0] / norm, m[i, 1] / norm, 1.0 / norm
    R_seed, t_seed, c_seed = np.empty((16, 3, 3)), np.empty((16, 3)), np.empty(16)
    available = ordered_seeds(X, f, m, A, R_seed, t_seed, c_seed)
    limit = Rs.shape[0]
    started = np.empty((8, 3, 3))
    runs = 0
    count = 0
    use_mirror = False
    while runs < 8:
        if use_mirror:
            R0, t0 = mirrored(Rs[0], ts[0], normal), mix3(1.0, ts[0], 0.0, ts[0])
        else:
            seed = -1
            for k in range(available):
                if np.isfinite(c_seed[k]) and (seed < 0 or c_seed[k] < c_seed[seed]):
                    seed = k
            if seed < 0:
                break
            c_seed[seed] = np.inf
            R0, t0 = R_seed[seed], t_seed[seed]
            near = False
            for k in range(runs):
                near = near or rotation_distance(R0, started[k]) < 0.05  # 13 deg
            for k in range(count):
                near = near or rotation_distance(R0, Rs[k]) < 0.05
            if near:
                continue
        put2(started[runs], R0)
        runs += 1
        R, t, cost, N, _ = minimise(R0, t0, X, m, A)
        use_mirror = not use_mirror and runs == 1
        if not np.isfinite(cost):
            continue
        known = False
        for k in range(count):
            known = known or (rotation_distance(R, Rs[k]) < 1e-5 and abs(cost - costs[k]) < 1e-3 * (1.0 + cost))
        if known or count == limit:
            continue
        k = count
        while k > 0 and costs[k - 1] > cost:
            put2(Rs[k], Rs[k - 1])
            put1(ts[k], ts[k - 1])
            put2(Ns[k], Ns[k - 1])
            costs[k] = costs[k - 1]
            k -= 1
        put2(Rs[k], R)
        put1(ts[k], t)
        put2(Ns[k], N)
        costs[k] = cost
        count += 1
    return count


@jit
def profile(R, t, direction, X, m, A, normal):
    """Chi-square minimised over position and roll while the object's normal points along `direction` (camera axes).

    Returns: R, t, chi-square, log determinant of the remaining 4x4 information.
    """
    n = times3(R, normal)
    if dot3(n, direction) > -0.99:
        R = product3(turn_onto(n, direction), R)
    g, N, H = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    g4, x4, H4, N4, L4 = np.empty(4), np.empty(4), np.empty((4, 4)), np.empty((4, 4)), np.zeros((4, 4))
    cost = expand(R, t, X, m, A, g, N, H)
    for _ in range(12):
        if not np.isfinite(cost):
            break
        _contract(N, direction, N4)
        _contract(H, direction, H4)
        for i in range(3):
            g4[i] = g[i]
        g4[3] = g[3] * direction[0] + g[4] * direction[1] + g[5] * direction[2]
        if not solve_damped(H4, N4, 0.0, g4, x4, L4) and not solve_damped(N4, N4, 1e-6, g4, x4, L4):
            break
        step = 1.0
        improved = False
        for _try in range(4):
            R_new = product3(rotation_of(mix3(step * x4[3], direction, 0.0, direction)), R)
            t_new = mix3(1.0, t, step, x4)
            new = chi_square(R_new, t_new, X, m, A)
            if new <= cost:
                improved = True
                break
            step *= 0.25
        if not improved:
            break
        fall = cost - new
        R, t = R_new, t_new
        cost = new
        if fall < 1e-3:
            break
        cost = expand(R, t, X, m, A, g, N, H)
    log_det = 0.0
    for i in range(4):
        log_det += 2.0 * np.log(L4[i, i])
    return R, t, cost, log_det


@jit
def _contract(M, direction, out):
    """The 4x4 block of M over position and roll about `direction`."""
    for i in range(3):
        for j in range(3):
            out[i, j] = M[i, j]
        s = 0.0
        for k in range(3):
            s += M[i, 3 + k] * direction[k]
        out[i, 3] = out[3, i] = s
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += direction[i] * M[3 + i, 3 + j] * direction[j]
    out[3, 3] = s


@jit
def prepare(pixels, covariance, camera, m, A):
    """Pixels (N, 2) with covariance (N, 2, 2) to ideal normalised coordinates m and information A (N, 3).

    `camera`: fx, fy, cx, cy, k1, k2, p1, p2, k3. The lens is inverted by Newton's method, see `camera_model`.

    Returns: -1, or the index of a point that the lens model cannot have produced, or N + index of a covariance that is
    not positive definite.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    bent = k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0
    count = pixels.shape[0]
    for i in range(count):
        xd, yd = (pixels[i, 0] - cx) / fx, (pixels[i, 1] - cy) / fy
        x, y = xd, yd
        jxx, jxy, jyy = 1.0, 0.0, 1.0
        if bent:
            error = np.inf
            for _ in range(20):
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
                ex = xd - (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
                ey = yd - (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
                jxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                jyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                jxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                det = jxx * jyy - jxy * jxy
                if not det > 0.0:
                    return i
                error = abs(ex) + abs(ey)
                if error < 1e-14:
                    break
                x += (jyy * ex - jxy * ey) / det
                y += (jxx * ey - jxy * ex) / det
            if not error < 1e-9:
                return i
        m[i, 0], m[i, 1] = x, y
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        det = a * c - b * b
        if not (a > 0.0 and det > 0.0 and b == covariance[i, 1, 0]):
            return count + i
        # Information of the pixel, then by the chain rule that of the ideal coordinate: A = J^T S^-1 J.
        iu, iv, iw = c / det, -b / det, a / det
        g00, g01, g10, g11 = fx * jxx, fx * jxy, fy * jxy, fy * jyy
        A[i, 0] = g00 * g00 * iu + 2.0 * g00 * g10 * iv + g10 * g10 * iw
        A[i, 1] = g00 * g01 * iu + (g00 * g11 + g10 * g01) * iv + g10 * g11 * iw
        A[i, 2] = g01 * g01 * iu + 2.0 * g01 * g11 * iv + g11 * g11 * iw
    return -1


@jit
def plane_of(X):
    """Unit normal of the plane nearest to centred points X (N, 3), and their spread across their main line (m^2)."""
    M = np.zeros((3, 3))
    for n in range(X.shape[0]):
        for i in range(3):
            for j in range(3):
                M[i, j] += X[n, i] * X[n, j]
    trace = M[0, 0] + M[1, 1] + M[2, 2]
    normal = np.zeros(3)
    if not trace > 0.0:
        return normal, 0.0
    for i in range(3):
        for j in range(3):
            M[i, j] /= trace
    C = cofactors(M)
    second = C[0, 0] + C[1, 1] + C[2, 2]
    det = M[0, 0] * C[0, 0] + M[0, 1] * C[0, 1] + M[0, 2] * C[0, 2]
    least = -real_cubic_root(1.0, second, det)  # the characteristic polynomial in -lambda
    for i in range(3):
        M[i, i] -= least
    C = cofactors(M)  # proportional to n n^T
    k = 0
    for i in range(1, 3):
        if C[i, i] > C[k, k]:
            k = i
    size = np.sqrt(C[0, k] ** 2 + C[1, k] ** 2 + C[2, k] ** 2)
    if size > 0.0:
        for i in range(3):
            normal[i] = C[i, k] / size
    return normal, second * trace


@jit
def inverse6(N, out):
    """Inverse of a positive definite 6x6 matrix, column by column; False when it is not."""
    g, x, L = np.zeros(6), np.empty(6), np.zeros((6, 6))
    for k in range(6):
        for i in range(6):
            g[i] = 0.0
        g[k] = -1.0
        if not solve_damped(N, N, 0.0, g, x, L):
            return False
        for i in range(6):
            out[i, k] = x[i]
    for i in range(6):
        for j in range(i):
            out[i, j] = out[j, i] = 0.5 * (out[i, j] + out[j, i])
    return True


@jit
def normal_spread(R, t, C, normal):
    """Area sqrt(det) of the normal's covariance (sr), and the squared number of sigmas to the line of sight."""
    n = times3(R, normal)
    k = unit3(t)
    a = cross3(n, k)
    sine = np.sqrt(dot3(a, a))
    tilt = np.arctan2(sine, abs(dot3(n, k)))
    if sine < 1e-9:
        a = sight_frame(n)[0]
    a = unit3(a)
    b = cross3(n, a)
    caa = cab = cbb = 0.0
    for i in range(3):
        for j in range(3):
            caa += a[i] * C[3 + i, 3 + j] * a[j]
            cab += a[i] * C[3 + i, 3 + j] * b[j]
            cbb += b[i] * C[3 + i, 3 + j] * b[j]
    return np.sqrt(max(caa * cbb - cab * cab, 0.0)), tilt * tilt / caa


@jit
def opposite(normal_camera, best, far):
    """Is this normal nearer to the mirror of the best one than to itself, and more than `far` (cosine) off it?

    Both face the camera (n . k > 0), in axes whose third is the line of sight k. The mirror of n is 2 (n.k) k - n.
    """
    lateral = normal_camera[0] * best[0] + normal_camera[1] * best[1]
    return lateral < 1e-9 and lateral + normal_camera[2] * best[2] < far


@jit
def sight_frame(t):
    """Rows: two axes across the line of sight to t, then the line of sight."""
    k = unit3(t)
    a = np.empty(3)
    if abs(k[1]) < 0.9:  # k x (0, 1, 0), or k x (1, 0, 0)
        a[0], a[1], a[2] = -k[2], 0.0, k[0]
    else:
        a[0], a[1], a[2] = 0.0, k[2], -k[1]
    a = unit3(a)
    F = np.empty((3, 3))
    put1(F[0], a)
    put1(F[1], cross3(k, a))
    put1(F[2], k)
    return F


@jit
def ring_mass(R, t, cost, X, m, A, normal):
    """Posterior mass of the normals on this and on the other side of the line of sight, and the middle pose there.

    The posterior over the normal is exp(-chi2 / 2) det(information of position and roll)^(-1/2); beforehand all
    directions in space are equally likely. It is summed over rings of tilt about the line of sight to the centroid.

    Returns: mass here, mass there (sr, in units of the density at the best pose), R, t, chi-square in the middle of
    the mass there.
    """
    F = sight_frame(t)
    best = times3(F, times3(R, normal))
    side = 1.0 if best[2] > 0.0 else -1.0
    best = mix3(side, best, 0.0, best)
    _, _, _, reference = profile(R, t, back3(F, best, side), X, m, A, normal)
    tilt_best = np.arccos(min(1.0, best[2]))
    azimuth_best = np.arctan2(best[1], best[0])
    here = there = 0.0
    g = np.empty(3)
    middle = np.zeros(3)
    for a in range(RING_COUNT):
        azimuth = azimuth_best + 2.0 * np.pi * a / RING_COUNT
        Rw, tw = R, t
        tilt = 0.5 * RING_STEP_RAD
        while tilt < RING_END_RAD:
            g[0], g[1], g[2] = np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)
            Rn, tn, c, log_det = profile(Rw, tw, back3(F, g, side), X, m, A, normal)
            if np.isfinite(c):
                Rw, tw = Rn, tn
                w = np.exp(-0.5 * (c - cost) - 0.5 * (log_det - reference)) * np.sin(tilt)
                if opposite(g, best, MIRROR_TURN_COS):
                    there += w
                    for i in range(3):
                        middle[i] += w * g[i]
                else:
                    here += w
            if c - cost > 40.0 and tilt > 1.2 * tilt_best + RING_STEP_RAD:
                break
            tilt += RING_STEP_RAD
    cell = RING_STEP_RAD * 2.0 * np.pi / RING_COUNT
    if not dot3(middle, middle) > 0.0:
        return here * cell, 0.0, R, t, np.inf
    R, t, cost, _ = profile(R, t, back3(F, unit3(middle), side), X, m, A, normal)
    return here * cell, there * cell, R, t, cost


@jit
def solve(points, pixels, covariance, camera, near_sigmas2, Rs, ts, costs, Cs, masses):
    """Everything about one view: minima with covariance and posterior mass, lowest chi-square first.

    Args:
        near_sigmas2: the rings are summed when the line of sight is nearer to the best normal (sigmas squared).
        Rs (M, 3, 3), ts (M, 3), costs (M,), Cs (M, 6, 6), masses (M,): filled. Poses are of the object's own origin.
            When the other side of the line of sight has mass but no minimum, its middle is appended, covariance 0.

    Returns: number of poses, number of them that are minima, error code (0 fine, others in `quadrangle`).
    """
    m, A, X = np.empty((4, 2)), np.empty((4, 3)), np.empty((4, 3))
    bad = prepare(pixels, covariance, camera, m, A)
    if bad >= 0:
        return bad, 0, 1
    c = np.zeros(3)
    for i in range(4):
        for j in range(3):
            c[j] += 0.25 * points[i, j]
    size = 0.0
    for i in range(4):
        for j in range(3):
            X[i, j] = points[i, j] - c[j]
            size += X[i, j] ** 2
    normal, spread = plane_of(X)
    if not spread > 1e-6 * size:
        return 0, 0, 2
    Ns = np.empty((Rs.shape[0], 6, 6))
    count = all_minima(X, m, A, normal, Rs[:-1], ts[:-1], costs[:-1], Ns[:-1])
    if count == 0:
        return 0, 0, 3
    while costs[count - 1] - costs[0] > WORTHLESS:  # among them runs that fled to infinity, where everything is flat
        count -= 1
    F = sight_frame(ts[0])
    best = times3(F, times3(Rs[0], normal))
    side = 1.0 if best[2] > 0.0 else -1.0
    best = mix3(side, best, 0.0, best)
    area0 = gate = 0.0
    over_there = 0.0
    there_too = np.zeros(Rs.shape[0], np.bool_)
    for k in range(count):
        if not inverse6(Ns[k], Cs[k]):
            return 0, 0, 4
        # Laplace: mass of a minimum over all six parameters, relative to the best one's.
        ratio = 1.0
        if k == 0:
            area0, gate = normal_spread(Rs[0], ts[0], Cs[0], normal)
        else:
            ratio = np.exp(-0.5 * (costs[k] - costs[0]) + 0.5 * (log_det6(Cs[k]) - log_det6(Cs[0])))
        masses[k] = ratio
        there_too[k] = k > 0 and opposite(
            mix3(side, times3(F, times3(Rs[k], normal)), 0.0, best), best, MIRROR_TURN_COS
        )
        if there_too[k]:
            over_there += ratio
    minima = count
    if gate < near_sigmas2:
        here, there, R, t, cost = ring_mass(Rs[0], ts[0], costs[0], X, m, A, normal)
        laplace = 2.0 * np.pi * area0
        ratio = there / max(here, laplace)
        if over_there > 0.0:  # share the better figure among the minima over there
            for k in range(1, count):
                if there_too[k]:
                    masses[k] *= max(1.0, ratio / over_there)
        elif ratio > 1e-4 and np.isfinite(cost):
            put2(Rs[count], R)
            put1(ts[count], t)
            costs[count], masses[count] = cost, ratio
            for i in range(6):
                for j in range(6):
                    Cs[count, i, j] = 0.0
            count += 1
    for k in range(count):
        lever = times3(Rs[k], c)
        move_origin(Cs[k], lever)
        put1(ts[k], mix3(1.0, ts[k], -1.0, lever))
    return count, minima, 0


@jit
def log_det6(C):
    """Log determinant of a positive definite 6x6 matrix."""
    g, x, L = np.zeros(6), np.empty(6), np.zeros((6, 6))
    solve_damped(C, C, 0.0, g, x, L)
    total = 0.0
    for i in range(6):
        total += 2.0 * np.log(L[i, i])
    return total


@jit
def move_origin(C, lever):
    """Covariance for the origin at -lever (camera axes) of the point it was for: d <- d + [lever]x r, in place."""
    for _ in range(2):  # J C, then (J (J C)^T)^T by the same loop on the transpose
        for k in range(6):
            r0, r1, r2 = C[3, k], C[4, k], C[5, k]
            C[0, k] += lever[1] * r2 - lever[2] * r1
            C[1, k] += lever[2] * r0 - lever[0] * r2
            C[2, k] += lever[0] * r1 - lever[1] * r0
        for i in range(6):
            for j in range(i):
                C[i, j], C[j, i] = C[j, i], C[i, j]
