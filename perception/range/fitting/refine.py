"""Damped Gauss-Newton steps on the ray residuals of one surface (Levenberg's damping, Marquardt's scaling).

`fit` chooses initial parameters, weights and kinds; this module descends from there.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Mask
from hal.jit import compiled
from hal.least_squares import DampingRule, next_damping
from hal.small_algebra import solve_positive
from perception.range.fitting.equations import normal_equations
from perception.range.fitting.rays import ERRED, LOADED, SCRATCH
from perception.range.fitting.surfaces import (
    FREEDOM,
    SIZE,
    frame_of,
    step_into,
)

# Slower than elsewhere, because a fit takes few steps and the weights change with the residuals.
RULE = DampingRule(fall=0.2, rise=10.0, least=1e-9, restart=0.0, most=1e6)
FLOOR = 1e-12  # of the Gauss-Newton matrix
STEP_GOAL = 1e-3  # in standard deviations of each parameter: smaller steps are negligible


@compiled
def new_scratch(samples: int) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array]:
    """Allocate the work arrays of a fit to at most `samples` samples.

    In this order: the rows of `rays`; matrix (9, 9) and gradient (9,) of the current parameters, and of the trial
    parameters; matrix and vector of a step; tangent frames of the current and of the trial parameters; trial
    parameters; residuals.
    """
    small = np.empty(3 * 81 + 3 * 9 + 2 * 6 + SIZE)  # one allocation instead of nine
    H, H2, A = small[:81].reshape((9, 9)), small[81:162].reshape((9, 9)), small[162:243].reshape((9, 9))
    g, g2, step = small[243:252], small[252:261], small[261:270]
    frame, new_frame, trial = small[270:276], small[276:282], small[282:]
    return np.empty(SCRATCH), H, g, H2, g2, A, step, frame, new_frame, trial, np.empty(samples)


@compiled
def refine(
    kind: int, th: Array, x: Array, y: Array, z: Array, sigma: Array, perspective: bool, steps: int, scale: float,
    trim: float, fixed: Mask,
    scratch: tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array], held: int,
) -> tuple[float, int, int]:  # fmt: skip
    """Minimise the ray residuals with at most `steps` damped Gauss-Newton steps; updates the parameters `th` in place.

    Args:
        x, y, z, sigma: (N,) samples; coordinates as in `Grid`.
        scale: > 0: width of the Cauchy weights in sigmas; 0: trim at `trim` and plain least squares.
        fixed: (9,) bool, tangent parameters that stay at their prior value.
        scratch: work arrays of `new_scratch`.
        held: which rows for these samples and `th` are valid in `scratch` (NOTHING, LOADED, ERRED or FILLED).

    Returns:
        cost, number of samples used, and which rows for the samples and the final `th` are valid in `scratch`.
    """
    work, H, g, H2, g2, A, step, frame, new_frame, trial, _ = scratch
    p = FREEDOM[kind]
    frame_of(kind, th, frame)
    goes_on = steps > 0
    cost, used = normal_equations(kind, th, frame, x, y, z, sigma, perspective, scale, trim, H, g, work, held, goes_on)
    held = min(held, LOADED)
    damping, is_fresh = 1e-4, True
    for turn in range(steps):
        if not free_step(H, g, fixed, damping, p, A, step):
            damping = next_damping(damping, False, RULE)
            if damping > RULE.most:
                break
            continue
        small = 0.0
        for a in range(p):
            small = max(small, abs(step[a]) * np.sqrt(H[a, a]))
        goes_on = turn + 1 < steps and not small < STEP_GOAL * 30.0
        step_into(kind, th, frame, step, trial)
        frame_of(kind, trial, new_frame)
        new_cost, new_used = normal_equations(
            kind, trial, new_frame, x, y, z, sigma, perspective, scale, trim, H2, g2, work, held, goes_on
        )
        is_fresh = new_cost <= cost and new_used >= p
        if is_fresh:
            cost, used = new_cost, new_used
            for i in range(SIZE):
                th[i] = trial[i]
            for i in range(6):
                frame[i] = new_frame[i]
            if not goes_on:
                break
            for a in range(p):
                g[a] = g2[a]
                for b in range(p):
                    H[a, b] = H2[a, b]
        elif small < STEP_GOAL:
            break
        damping = next_damping(damping, is_fresh, RULE)
        if damping > RULE.most:
            break
    return cost, used, ERRED if is_fresh and held == LOADED else held


@compiled
def free_step(H: Array, g: Array, fixed: Mask, damping: float, p: int, A: Array, step: Array) -> bool:
    """Write the damped step of the free parameters into `step` (p,), zero for the `fixed` ones; `A` (p, p) is overwritten.

    `H` and `g` are the Gauss-Newton matrix and gradient. Returns False if the matrix is not positive definite. The damping
    multiplies the diagonal, because another order of rounding (`solve_damped` adds it) changes which surfaces of real
    images are merged.
    """
    for a in range(p):
        for b in range(a + 1):
            A[a, b] = 0.0 if fixed[a] or fixed[b] else H[a, b]
        A[a, a] = 1.0 if fixed[a] else A[a, a] * (1.0 + damping) + FLOOR
        step[a] = 0.0 if fixed[a] else g[a]
    return solve_positive(A, step, p)
