"""Pressing a cap with the closed fingertip: the part that button and mushroom share."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from hal.errors import Unprovable
from hal.panel import Button, Mushroom
from hal.panel.parts import LATCHED_SHARE
from manipulation.skills import cap as feeling
from manipulation.skills.attempt import Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify
from manipulation.skills.repeat import MAX_ATTEMPTS, perform

PUSHES = 2  # of a latching cap in one attempt: where its state cannot be felt before, the first may show that
LEAST_DEPTH_SIGMAS = 3.0  # of a felt height: the least depth of a latched cap that can be told from none
ENOUGH_SHARE = 0.8  # of the travel: a shorter push may have had no effect


def press_latching(
    context: SkillContext,
    cap: Button | Mushroom,
    target: str | None,
    *,
    skill: str,
    releases: bool,
    verify: Verify | None = None,
) -> SkillReport:
    """Press a cap that latches until it is felt to be in the target state.

    The witness is the height of the cap, felt by a light touch before the push and when the cap leaves the fingertip
    after it: a latched cap stays deeper. A cap that is felt to have the target state is not pressed, and is done if a look
    agrees with its height over the plate beside it. The mechanical estimate is how much deeper than before the cap stays, m.

    Args:
        target: `pressed` or `released`; None for the other state than it has.
        releases: whether a push releases a latched cap.
        verify: the caller's look; only a cap that has the target state already is looked at.

    Raises:
        Unprovable: a latched cap stands hardly deeper than a released one.
    """
    depth_m = LATCHED_SHARE * cap.travel_m
    if depth_m < LEAST_DEPTH_SIGMAS * feeling.FELT_SIGMA_M:
        raise Unprovable(
            f"{cap.name} stays only {1e3 * depth_m:.1f} mm deeper when it is pressed, which no touch can prove: at least "
            f"{1e3 * LEAST_DEPTH_SIGMAS * feeling.FELT_SIGMA_M:.1f} mm can be felt",
            hint="correct travel_m in the panel file, or let the button light a lamp that shows its state",
            object=cap.name,
        )
    tries = itertools.count()

    def stroke(attempt: Attempt) -> float:
        return _latch(attempt, cap, target, verify, releases=releases, is_firm=next(tries) > 0)

    return perform(
        context,
        stroke,
        skill=skill,
        object_name=cap.name,
        target=target or "the other state",
        is_reached=lambda seen: seen.state == (target or seen.state),
        verify=None,  # the difference of two felt heights is surer than a look: of 26 looks 3 were wrong
    )


def press_once(
    context: SkillContext,
    cap: Button,
    *,
    target: str,
    is_reached: Callable[[ObjectState], bool],
    verify: Verify | None,
    is_there: bool,
) -> SkillReport:
    """Press a cap that springs back, once.

    The mechanical estimate is the travel of the cap in metres. The witness is the caller's look at what the button
    works; without one, it is the felt travel, and that the cap came back.

    Args:
        is_there: the target has been seen already, so the cap is pressed only if the read-back no longer shows it.
    """
    tries = itertools.count()

    def stroke(attempt: Attempt) -> float | None:
        number = next(tries)
        if is_there and number == 0:
            attempt.cause = "nothing was moved, because it was seen there already"
            return None
        first = feeling.touch(attempt, cap)
        firm = verify is None or number > (1 if is_there else 0)
        give = feeling.push(attempt, cap, first, way_m=cap.travel_m, is_firm=firm)
        deeper_m = feeling.let_go(attempt, first)
        attempt.leave()
        if cap.latching:  # its way depends on its state, and the caller's look decides
            return give.travel_m
        if give.travel_m < ENOUGH_SHARE * cap.travel_m:
            what = f"it gave way by only {1e3 * give.travel_m:.1f} mm under {give.force_n:.0f} N"
            raise SkillFailure(Outcome.STALLED, what, reached=give.travel_m)
        if abs(deeper_m) > feeling.LATCH_MOVED * LATCHED_SHARE * cap.travel_m:
            what = f"it did not come back: it stays {1e3 * deeper_m:.1f} mm deeper than before"
            raise SkillFailure(Outcome.STALLED, what, reached=give.travel_m)
        if verify is None:
            _note(attempt, cap, target, f"it was felt to give way by {1e3 * give.travel_m:.1f} mm and to come back")
        return give.travel_m

    return perform(
        context,
        stroke,
        skill="button",
        object_name=cap.name,
        target=target,
        is_reached=is_reached,
        verify=verify,
        attempts=2 if is_there else MAX_ATTEMPTS,
        repeats=lambda: is_there,
    )


def _latch(
    attempt: Attempt,
    cap: Button | Mushroom,
    target: str | None,
    verify: Verify | None,
    *,
    releases: bool,
    is_firm: bool,
) -> float:
    """Feel the cap and press it until it is felt to have the target state; returns how much deeper it stays, m."""
    first = feeling.touch(attempt, cap)
    before, is_beside = feeling.state_by_touch(attempt, cap, first, in_doubt=target)
    if target is not None and before == target:
        _leave_there(attempt, cap, target, verify if is_beside else None)
        return 0.0
    if before == "pressed" and not releases:
        raise SkillFailure(Outcome.STALLED, "it is latched, and no push releases it")
    for _ in range(PUSHES):
        if not feeling.is_at(attempt, first):
            first = feeling.touch(attempt, cap)
        latched_m = LATCHED_SHARE * cap.travel_m
        way_m = cap.travel_m - (latched_m if before == "pressed" else 0.0)
        give = feeling.push(attempt, cap, first, way_m=way_m, is_firm=is_firm or before is None)
        deeper_m = feeling.let_go(attempt, first)
        attempt.leave()
        if abs(deeper_m) < feeling.LATCH_MOVED * latched_m:
            what = f"it gave way by {1e3 * give.travel_m:.1f} mm under {give.force_n:.0f} N and stays where it was"
            raise SkillFailure(Outcome.STALLED, what, reached=deeper_m)
        before = "pressed" if deeper_m > 0 else "released"
        if before == (target or before):
            side = "deeper" if deeper_m > 0 else "higher"
            _note(attempt, cap, before, f"it was felt to stay {1e3 * abs(deeper_m):.1f} mm {side} than before")
            return deeper_m
    raise SkillFailure(Outcome.STALLED, f"it was pressed {PUSHES} times and is {before}")


def _leave_there(attempt: Attempt, cap: Button | Mushroom, target: str, verify: Verify | None) -> None:
    """Leave a cap that is felt to have the target state; a look that agrees proves it.

    Its height alone does not: by the pose of the panel it told the wrong state in 2 of 16 sweeps.
    """
    attempt.leave()
    seen = None if verify is None else verify()
    if seen is not None and seen.state == target:
        _note(attempt, cap, target, f"it was felt and seen to be {target} already and was not pressed")
        return
    shown = "no look confirms it" if seen is None or seen.state is None else f"the look shows it {seen.state}"
    attempt.cause = (
        f"it was felt to be {target} already and was not pressed; its height alone does not prove that, and {shown}"
    )


def _note(attempt: Attempt, cap: Button | Mushroom, state: str, cause: str) -> None:
    attempt.felt = ObjectState(name=cap.name, state=state)
    attempt.cause = cause
