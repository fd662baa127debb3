"""Moves a slider: locates a face of its cap by touch and pushes it by the missing distance.

Two witnesses must agree before the deed is done: the look afterwards, and the look before together with the way that the
fingertip pushed the cap. At least one of them must be sure that the cap is within the tolerance: the look is less sure where
the cap hides one end of its slot, and there the push decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.errors import InvalidRequest, Unprovable
from hal.motion import Guard, Quantity
from hal.panel import Scale, Slider
from manipulation.planning.cartesian_path import shifted
from manipulation.skills.attempt import STANDOFF_M, Attempt
from manipulation.skills.contact import meet, onset
from manipulation.skills.context import SkillContext, panel_from_grip
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import (
    SURE,
    ObjectState,
    Outcome,
    SkillFailure,
    SkillReport,
    Verify,
    doubt_within,
    surely_within,
)
from manipulation.skills.repeat import perform

TIP_HEIGHT_M = 0.007  # height of the fingertip above the plate; with a pose error it does not touch the plate
SIDE_M = 0.009  # free space between fingertip and cap when approaching
SEEK_M = 0.022
SEEK_M_PER_S = 0.02
SEEK_N = 1.3  # above noise and inertia, and below the friction of most sliders
# The friction of a lighter slider is felt by its duration: the arm speeds up for 20 ticks only, and noise of 0.3 N is not
# above this force for so long.
LIGHT_N, LIGHT_TICKS = 0.5, 25
PUSH_M_PER_S = 0.08
SHORT_M = 0.003  # the push pauses at this distance from the end to measure how far the tip is pressed beyond the face
LET_GO_M, LET_GO_M_PER_S = 0.004, 0.03
TOLERANCE_RATIO = 0.02
LARGEST_STOP_N = 36.0
SEEN_SIGMA_M = 0.00015  # of the best look: a third of a pixel from close up
PUSH_SIGMA_M = 0.00025  # of the way that a cap was pushed; RMS error of 40 pushes on random panels


@dataclass(frozen=True, slots=True, kw_only=True)
class Felt:
    """Value to which a slider was felt to be pushed, with one standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Push:
    """Start and goal of a push along the track, measured from its middle, m."""

    start_m: float
    goal_m: float

    @property
    def sign(self) -> float:
        return 1.0 if self.goal_m >= self.start_m else -1.0


@dataclass(slots=True, kw_only=True)
class _Witnesses:
    """The look at a slider after a push, and what was felt of the push: together they tell whether it is at its target.

    Attributes:
        felt: of the newest push; None before it.
        have_disagreed: whether the newest look contradicted the push before it.
    """

    scale: Scale
    target: float
    felt: Felt | None = None
    have_disagreed: bool = False

    @property
    def _allowed(self) -> float:
        return TOLERANCE_RATIO * (self.scale.maximum - self.scale.minimum)

    def is_reached(self, seen: ObjectState) -> bool:
        """Return whether one of the two is surely within the tolerance, and the other one agrees."""
        is_too_unsure = SURE * seen.sigma > self._allowed  # it would contradict nothing
        if self.felt is None or is_too_unsure or between_witnesses(self.scale, seen, self.felt):
            return False
        return any(surely_within(one.value, self.target, self._allowed, sigma=one.sigma) for one in (seen, self.felt))

    def doubt(self, seen: ObjectState) -> str:
        """Return why the slider may or may not be at its target; nothing if the look surely shows it there or elsewhere."""
        self.have_disagreed = False
        if self.is_reached(seen):
            return ""
        doubtful = doubt_within(seen.value, self.target, self._allowed, sigma=seen.sigma)
        if not doubtful and not surely_within(seen.value, self.target, self._allowed, sigma=seen.sigma):
            return ""
        between = between_witnesses(self.scale, seen, self.felt)
        self.have_disagreed = bool(between)
        return between or doubtful


def slider(
    context: SkillContext,
    fader: Slider,
    target: float,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Push the slider to a value of its scale.

    The distance to push is the difference of two values, and the cap's face is found by touch, so an error of the
    panel's pose does not affect the result. The mechanical estimate in the report is the value reached.

    Args:
        current: what the last observation showed; without it `verify` is asked first.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: the value is off the scale, or the present value is not known.
        Unprovable: the track is so short that no look is fine enough.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    name = fader.name
    scale = fader.scale
    if not scale.minimum <= target <= scale.maximum:
        raise InvalidRequest(
            f"{target} {scale.unit} is off the scale of {name}", hint=f"{scale.minimum} to {scale.maximum} {scale.unit}"
        )
    _check_provable(fader)
    where = InitialState(lambda seen: seen.value, what=f"the value of {name}", current=current, verify=verify)
    witnesses = _Witnesses(scale=scale, target=target)

    def stroke(attempt: Attempt) -> float:
        witnesses.felt = None
        push = _Push(start_m=scale.place_of(where.known), goal_m=scale.place_of(target))
        value = scale.value_at(push.start_m + _push(attempt, fader, push))
        witnesses.felt = Felt(value=value, sigma=float(np.hypot(where.sigma, PUSH_SIGMA_M / _metres_per_unit(scale))))
        return where.moved_to(value)

    return perform(
        context,
        stroke,
        skill="slider",
        object_name=name,
        target=f"{target:g} {scale.unit}".strip(),
        is_reached=witnesses.is_reached,
        doubt=witnesses.doubt,
        verify=where.verify,
        # A look that errs is followed by a push that errs as much, so that the two would agree the next time.
        repeats=lambda: not witnesses.have_disagreed,
    )


def _check_provable(fader: Slider) -> None:
    allowed_m = TOLERANCE_RATIO * abs(fader.scale.at_max - fader.scale.at_min)
    if allowed_m <= SURE * SEEN_SIGMA_M:
        raise Unprovable(
            f"{100 * TOLERANCE_RATIO:g} % of its way of {fader.name} are {1e3 * allowed_m:.2f} mm, and the best look at it is sure "
            f"to {1e3 * SURE * SEEN_SIGMA_M:.2f} mm only",
            hint="operate it by hand, or correct travel_m in the panel file",
            object=fader.name,
        )


def between_witnesses(scale: Scale, seen: ObjectState, felt: Felt | None) -> str:
    """Return how a look at the slider and the push that was felt disagree by more than they may err; nothing if they agree."""
    if seen.value is None or felt is None:
        return "no look shows it" if seen.value is None else "no push was felt"
    apart = abs(seen.value - felt.value)
    if apart <= SURE * float(np.hypot(seen.sigma, felt.sigma)):
        return ""
    apart_mm = 1e3 * apart * _metres_per_unit(scale)
    return f"the look shows {seen.value:.4g} and the push was felt to end at {felt.value:.4g}, {apart_mm:.1f} mm apart"


def _metres_per_unit(scale: Scale) -> float:
    return abs(scale.at_max - scale.at_min) / (scale.maximum - scale.minimum)


def _push(attempt: Attempt, fader: Slider, push: _Push) -> float:
    """Push once; returns how far the cap moved along the track, m, signed."""
    context = attempt.context
    half_x, half_y = context.hand.closed_half_m
    turns = ((0.0, half_x), (np.pi, half_x), (np.pi / 2, half_y), (-np.pi / 2, half_y))
    ways = [_way(fader, push, turn, half) for turn, half in turns]
    attempt.begin(ways, may_touch=(fader.name,), width_m=0.0, name=fader.name, leans_about=(0, 1))
    top = fader.cap_size_m[2]
    down = attempt.advance(STANDOFF_M + top - TIP_HEIGHT_M, name="approach")
    if down.tripped is not None:
        height = (context.panel_pose.inv() * attempt.pose()).translation[2]
        if height > 0.6 * top:
            raise SkillFailure(Outcome.MISSED, "the fingertip landed on the cap")
        attempt.advance(-0.002, name="lift off the plate", speed_m_per_s=0.03)
    ahead = push.sign * context.panel_pose.rotation.apply([np.cos(fader.angle_rad), np.sin(fader.angle_rad), 0.0])
    begun = attempt.pose().translation
    met = meet(
        attempt,
        _moved(attempt, SEEK_M * ahead),
        name="feel the cap",
        speed_m_per_s=SEEK_M_PER_S,
        stop_n=SEEK_N,
        ticks=3,
        light=(LIGHT_N, LIGHT_TICKS),
    )
    if not met.is_met:
        raise SkillFailure(Outcome.MISSED, "no cap was met")
    # From the present place back to the face, not positive.
    face = float(met.way_m - (attempt.pose().translation - begun) @ ahead)
    length = abs(push.goal_m - push.start_m)
    start = attempt.pose().translation
    _go(attempt, fader, ahead, max(0.0, length + face - SHORT_M), "push")
    give = _let_go(attempt, ahead)
    so_far = float((attempt.pose().translation - start) @ ahead)
    _go(attempt, fader, ahead, max(0.0, length + face + give - so_far), "push to the end")
    loaded = float((attempt.pose().translation - start) @ ahead)
    moved = loaded - face - _let_go(attempt, ahead)
    attempt.leave()
    return push.sign * moved


def _way(fader: Slider, push: _Push, turn: float, half: float) -> list[RigidTransform]:
    along = np.array([np.cos(fader.angle_rad), np.sin(fader.angle_rad)])
    beside = fader.cap_size_m[0] / 2 + half + SIDE_M
    middle = np.array(fader.position_m)
    start = middle + (push.start_m - push.sign * beside) * along
    end = middle + (push.goal_m - push.sign * (beside - SIDE_M)) * along
    top = fader.cap_size_m[2]
    angle = fader.angle_rad + turn
    return [
        panel_from_grip((*start, top + STANDOFF_M), angle),
        panel_from_grip((*start, TIP_HEIGHT_M), angle),
        panel_from_grip((*(0.5 * (start + end)), TIP_HEIGHT_M), angle),
        panel_from_grip((*end, TIP_HEIGHT_M), angle),
    ]


def _moved(attempt: Attempt, way_m: np.ndarray) -> RigidTransform:
    pose = attempt.pose()
    return shifted(pose, pose.rotation.inv().apply(way_m))


def _go(attempt: Attempt, fader: Slider, ahead: np.ndarray, distance_m: float, name: str) -> None:
    if distance_m < 1e-4:
        return
    limit = min(3.0 * fader.friction_n + 15.0, LARGEST_STOP_N)
    guard = Guard(name="effort", quantity=Quantity.FORCE, limit=limit)
    start = attempt.pose().translation
    report = attempt.straight(
        _moved(attempt, distance_m * ahead), name=name, speed_m_per_s=PUSH_M_PER_S, guards=(guard,)
    )
    left_m = distance_m - float((report.base_from_tool.translation - start) @ ahead)
    if report.tripped is not None and left_m > SHORT_M:  # at the end of the track the stop comes a little early
        raise SkillFailure(Outcome.STALLED, f"the cap stopped against {report.peak_force_n:.0f} N")


def _let_go(attempt: Attempt, ahead: np.ndarray) -> float:
    """Move back from the cap; returns how far the tip had been pressed beyond its face, m.

    Friction holds the cap, so the force falls to zero where the tip leaves it. How much pads, fingers and arm yield to a push
    from this side need not be known.
    """
    loaded = attempt.pose()
    back = attempt.straight(_moved(attempt, -LET_GO_M * ahead), name="let go", speed_m_per_s=LET_GO_M_PER_S)
    depth = (back.log.tip_m - loaded.translation) @ ahead
    force = back.log.wrench[:, :3] @ loaded.rotation.inv().apply(-ahead)
    left, _ = onset(depth[::-1], force[::-1], 0.0)
    return max(0.0, -left)
