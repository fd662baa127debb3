"""Pressing a cap with the closed fingertip: the part that button and mushroom share."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from hal.motion import Guard, MotionReport, Quantity
from hal.panel import Button, Mushroom
from manipulation.planning.cartesian_path import shifted
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import SOFT_PUSH
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.probe import TURNS_RAD
from manipulation.skills.repeat import MAX_ATTEMPTS, perform

SEEK_N = 2.5  # a light contact ends the fast part of the approach, so that the slow part begins above or on the cap
SEEK_ABOVE_M = 0.004
PRESS_M_PER_S = 0.020
STOP_FLOOR_N = 15.0
EFFORT_SPREAD = 1.6  # three sigma of the panel file's effort tolerance
BOTTOM_N = 6.0  # beyond the spring force at full travel, where the cap is at its stop
DEEP_ENOUGH_RATIO = 0.3  # share of the travel that counts as a press; a latched cap has no more travel than this
LOST_M = 0.018  # largest distance of the cap behind its expected place, plus the compression of the soft push


def press(
    context: SkillContext,
    cap: Button | Mushroom,
    *,
    skill: str,
    target: str,
    is_reached: Callable[[ObjectState], bool],
    verify: Verify | None,
    is_there: bool = False,
) -> SkillReport:
    """Press a cap down to its stop and release it.

    The mechanical estimate is the travel of the cap in metres.

    Args:
        is_there: the target has been seen already, so the cap is pressed only if the read-back no longer shows it.
    """

    tries = itertools.count()

    def stroke(attempt: Attempt) -> float:
        if is_there and next(tries) == 0:
            return 0.0
        x, y = cap.position_m
        top = cap.height_m
        heights = (top + STANDOFF_M, top + SEEK_ABOVE_M, top - cap.travel_m)
        ways = [[panel_from_grip((x, y, z), turn) for z in heights] for turn in TURNS_RAD]
        attempt.begin(ways, may_touch=(cap.name,), width_m=0.0, name=cap.name)
        attempt.advance(STANDOFF_M - SEEK_ABOVE_M, name="approach", stop_n=SEEK_N)
        report = _push(attempt, cap)
        travel = travelled_m(report, context.hand.pad_stiffness_n_per_m)
        if report.tripped is None:
            raise SkillFailure(Outcome.MISSED, "no cap was met where it should be", reached=travel)
        if travel < DEEP_ENOUGH_RATIO * cap.travel_m:
            raise SkillFailure(Outcome.STALLED, f"it gave way by only {1e3 * travel:.1f} mm", reached=travel)
        attempt.leave()
        return travel

    return perform(
        context,
        stroke,
        skill=skill,
        object_name=cap.name,
        target=target,
        is_reached=is_reached,
        verify=verify,
        attempts=2 if is_there else MAX_ATTEMPTS,
        repeats=is_there,
    )


def stop_force_n(cap: Button | Mushroom) -> float:
    """Return the force at which the cap must have reached its stop, N."""
    full = cap.preload_n + cap.spring_n_per_m * cap.travel_m
    return max(STOP_FLOOR_N, EFFORT_SPREAD * full + BOTTOM_N)


def _push(attempt: Attempt, cap: Button | Mushroom) -> MotionReport:
    guard = Guard(name="bottom", quantity=Quantity.FORCE, limit=stop_force_n(cap), axis=(0.0, 0.0, -1.0), ticks=1)
    goal = shifted(attempt.pose(), (0.0, 0.0, SEEK_ABOVE_M + cap.travel_m + LOST_M))
    return attempt.straight(goal, name="press", speed_m_per_s=PRESS_M_PER_S, guards=(guard,), compliance=SOFT_PUSH)


def travelled_m(report: MotionReport, pad_stiffness_n_per_m: float) -> float:
    """Return how far the cap moved, m: the tip's travel under force minus the compression of the pads."""
    axis = report.base_from_tool.rotation.apply([0.0, 0.0, 1.0])
    depth, force = report.log.tip_m @ axis, -report.log.wrench[:, 2]
    loaded = np.flatnonzero(force > 1.0)
    if len(loaded) == 0:
        return 0.0
    give = float(force.max()) / pad_stiffness_n_per_m
    return max(0.0, float(depth.max() - depth[loaded[0]]) - give)
