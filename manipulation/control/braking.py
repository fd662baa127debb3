"""The last filter before the drive: joint range, speed and acceleration, braking ahead, and the speed of the tip.

Distances and speeds are per tick; `most` is the largest change of speed per tick.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from manipulation.arm.kernels import tool_and_jacobian


@inlined
def rest_way(speed: float, most: float) -> float:
    """Return the distance still covered after a tick at `speed` when every further tick is slower by `most`."""
    ticks = np.floor(speed / most)
    return float(ticks * speed - 0.5 * ticks * (ticks + 1.0) * most)


@inlined
def fastest_to_rest(way: float, most: float) -> float:
    """Return the speed per tick that comes to rest exactly after the distance `way`: v + rest_way(v, most) = way."""
    ticks = max(1.0, np.ceil(0.5 * (np.sqrt(1.0 + 8.0 * way / most) - 1.0)))
    return float(way / ticks + 0.5 * (ticks - 1.0) * most)


@inlined
def rest_place(place: float, speed: float, most: float) -> float:
    """Return where a joint that has just reached `place` at `speed` per tick can come to rest."""
    return float(place + np.sign(speed) * rest_way(abs(speed), most))


@inlined
def step_to_rest(way: float, most: float) -> float:
    """Return `fastest_to_rest` with the sign of `way`."""
    return float(np.sign(way) * fastest_to_rest(abs(way), most))


@inlined
def limited_step(
    wanted: Array,
    wanted_before: Array,
    last: Array,
    last_velocity: Array,
    velocity: Array,
    acceleration: Array,
    lower: Array,
    upper: Array,
    dt_s: float,
) -> Array:
    """Return the set-point (n,) nearest to `wanted` within the range, speed and acceleration limits of each joint.

    The step is never too fast to brake before the place where the wanted set-point would come to rest if it began to
    brake now. A motion within the limits is therefore followed exactly, and after a jump the goal is reached without
    overshoot. `wanted_before` (k, n) holds the previous wanted set-points, newest first. In each direction the fastest
    of the speeds between them counts, because ticks that come late or early make a steady motion look jerky.
    """
    out = np.empty_like(wanted)
    for i in range(wanted.shape[0]):
        most, fastest = acceleration[i] * dt_s * dt_s, velocity[i] * dt_s
        goal = min(max(wanted[i], lower[i]), upper[i])
        slow, fast, after = fastest, -fastest, goal
        for k in range(wanted_before.shape[0]):
            before = min(max(wanted_before[k, i], lower[i]), upper[i])
            slow, fast = min(slow, after - before), max(fast, after - before)
            after = before
        slow, fast = max(slow, -fastest), min(fast, fastest)  # the joint cannot follow faster than that
        below = min(max(rest_place(goal, slow, most), lower[i]), upper[i])
        above = min(max(rest_place(goal, fast, most), lower[i]), upper[i])
        step = min(max(goal - last[i], step_to_rest(below - last[i], most)), step_to_rest(above - last[i], most))
        low = max(-fastest, last_velocity[i] * dt_s - most)
        high = min(fastest, last_velocity[i] * dt_s + most)
        out[i] = last[i] + min(max(step, low), high)
    return out


@inlined
def slowed_step(
    jacobian: Array, step: Array, last_step: Array, most: Array, below: Array, above: Array, tip_m: float
) -> Array:
    """Return the joint step (n,) nearest to `step` that moves the tip by at most `tip_m`.

    It is sought between `step` and the step that keeps the present direction and brakes as hard as the acceleration
    limit allows (`most` (n,), per tick). Both respect acceleration and the range that is left (`below`, `above` (n,)),
    so every step between them does. If even full braking moves the tip too fast, that step is scaled down: the limit of
    the tip takes precedence over the others.
    """
    share = 1.0
    for i in range(step.shape[0]):
        if abs(last_step[i]) > most[i]:
            share = min(share, most[i] / abs(last_step[i]))
    brake = last_step * (1.0 - share)
    for i in range(step.shape[0]):
        brake[i] = max(-fastest_to_rest(below[i], most[i]), min(brake[i], fastest_to_rest(above[i], most[i])))
    harder = brake.copy()
    for i in range(step.shape[0]):  # a joint near its goal may brake harder if the tip limit allows it
        if (last_step[i] - brake[i]) * (brake[i] - step[i]) > 0.0:
            harder[i] = step[i]
    slow = jacobian[:3] @ harder
    if slow @ slow < tip_m * tip_m:
        brake = harder
    slow, change = jacobian[:3] @ brake, jacobian[:3] @ (step - brake)
    a, b, c = change @ change, slow @ change, slow @ slow - tip_m * tip_m
    if c >= 0.0:
        return brake * (tip_m / np.sqrt(slow @ slow))
    return brake + (step - brake) * ((np.sqrt(b * b - a * c) - b) / a)


@compiled
def safe_step(
    dh: Array,
    flange_from_tool: Array,
    wanted: Array,
    wanted_before: Array,
    last: Array,
    last_velocity: Array,
    velocity: Array,
    acceleration: Array,
    lower: Array,
    upper: Array,
    tip_limit_m_per_s: float,
    dt_s: float,
) -> Array:
    """Apply the last filter before the drive: joint range, speed and acceleration, and the speed of the tool's tip."""
    out = limited_step(wanted, wanted_before, last, last_velocity, velocity, acceleration, lower, upper, dt_s)
    out = np.minimum(np.maximum(out, lower), upper)
    _, jacobian = tool_and_jacobian(dh, last, flange_from_tool)
    tip = jacobian[:3] @ (out - last)
    tip_m = tip_limit_m_per_s * dt_s
    if tip @ tip > tip_m * tip_m:
        most, below, above = acceleration * dt_s * dt_s, np.maximum(last - lower, 0.0), np.maximum(upper - last, 0.0)
        out = last + slowed_step(jacobian, out - last, last_velocity * dt_s, most, below, above, tip_m)
    return out


def warm(dh: Array) -> None:
    """Compile the filter (or load it from the cache), so that no tick waits for a compiler."""
    n = dh.shape[0]
    q, ones = np.full(n, 0.1), np.ones(n)
    safe_step(dh, np.eye(4), q, np.zeros((2, n)), q, np.zeros(n), ones, ones, -ones, ones, 1e-9, 0.01)
