"""The common sequence of all skills: a stroke, a read-back, and at most two more attempts if they disagree."""

from __future__ import annotations

from collections.abc import Callable

from hal.errors import MotionRefused, Unreachable
from manipulation.skills.attempt import ENDED, Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, Outcome, SkillFailure, SkillReport, Verify, mean_of
from manipulation.skills.retreat import retreat

MAX_ATTEMPTS = 3
NO_READING, REFUSED = "; no reading was asked for afterwards", "; the reading afterwards was refused"

Stroke = Callable[[Attempt], float | None]
"""One try of the stroke; returns the mechanical estimate or raises `SkillFailure`."""


def perform(
    context: SkillContext,
    stroke: Stroke,
    *,
    skill: str,
    object_name: str,
    target: str,
    is_reached: Callable[[ObjectState], bool],
    doubt: Callable[[ObjectState], str] = lambda _: "",
    verify: Verify | None,
    attempts: int = MAX_ATTEMPTS,
    repeats: Callable[[], bool] = lambda: True,
) -> SkillReport:
    """Try a stroke, retreat, read back, and try at most twice more while the read-back does not show the target.

    There is no further try where the look shows that the panel has moved. A stroke that felt the target itself
    (`Attempt.felt`) needs no read-back; a look is no proof where the fingers felt the contrary, or missed in every try.

    Args:
        doubt: why a look shows neither the target nor the contrary; nothing if it shows one of them. After a doubt the control
            is looked at once more, and the mean of the two looks decides.
        repeats: whether a stroke that the look denies may be tried again, asked after each; a second press undoes a first.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on; the caller parks when that is possible.
    """
    attempt, started_s = Attempt(context), context.mover.state().stamp_s
    seen: ObjectState | None = None
    reached: float | None = None
    outcome, cause, tries, is_met, was_missed = Outcome.UNREACHABLE, "", 0, False, False
    for tries in range(1, attempts + 1):
        context.progress((tries - 1) / attempts, f"{skill} {object_name}: attempt {tries}")
        outcome, cause, reached = _try(attempt, stroke, object_name)
        context.progress((tries - 0.5) / attempts, f"{skill} {object_name}: {_next(attempt, outcome, cause, verify)}")
        if outcome is Outcome.UNREACHABLE:
            break
        if outcome is Outcome.UNVERIFIED and attempt.felt is not None and is_reached(attempt.felt):
            outcome, seen = Outcome.DONE, attempt.felt
            break
        is_met, was_missed = is_met or outcome is not Outcome.MISSED, was_missed or outcome is Outcome.MISSED
        seen = None if verify is None else _look(verify, doubt if outcome is Outcome.UNVERIFIED else None)
        if seen is not None and is_reached(seen) and is_met and not attempt.is_against:
            outcome, cause = Outcome.DONE, "the read-back confirms it"
            break
        if outcome is Outcome.UNVERIFIED:
            if seen is None:
                cause += REFUSED if verify is not None else NO_READING if cause == ENDED else ""
                break
            outcome, cause = _denied(doubt(seen))
        if outcome is Outcome.STALLED and seen is None and not repeats():
            cause += "; it is unknown whether it had an effect, and another try might undo it"
            break
        is_final = outcome is Outcome.STIFF or (outcome in (Outcome.SLIPPED, Outcome.UNVERIFIED) and not repeats())
        if is_final or not context.is_in_place():
            break
    return SkillReport(
        skill=skill, object=object_name, target=target, outcome=outcome, cause=cause, reached=reached, seen=seen,
        attempts=tries, started_s=started_s, ended_s=context.mover.state().stamp_s, motions=tuple(attempt.reports),
        peak_force_n=max((report.peak_force_n for report in attempt.reports), default=0.0), was_missed=was_missed,
    )  # fmt: skip


def _look(verify: Verify, doubt: Callable[[ObjectState], str] | None) -> ObjectState | None:
    """Return what a look shows, or the mean of two where the first one leaves a doubt."""
    seen = verify()
    if seen is None or doubt is None or not doubt(seen):
        return seen
    again = verify()
    return seen if again is None else mean_of(seen, again)


def _denied(doubt: str) -> tuple[Outcome, str]:
    """Return how a stroke ended that went all the way, where the look afterwards does not show the target."""
    if doubt:
        return Outcome.UNVERIFIED, f"{ENDED}, but {doubt}"
    return Outcome.SLIPPED, "the hand went all the way; the read-back does not show the target"


def _next(attempt: Attempt, outcome: Outcome, cause: str, verify: Verify | None) -> str:
    looks = outcome is Outcome.UNVERIFIED and verify is not None and attempt.felt is None
    return "look again" if looks else cause


def _try(attempt: Attempt, stroke: Stroke, object_name: str) -> tuple[Outcome, str, float | None]:
    attempt.felt, attempt.is_against, attempt.cause = None, False, ENDED
    try:
        reached = stroke(attempt)
        return Outcome.UNVERIFIED, attempt.cause, reached
    except SkillFailure as failure:
        attempt.is_against = failure.is_sure
        retreat(attempt.context, attempt)
        return failure.outcome, failure.cause, failure.reached
    except Unreachable as failure:
        return Outcome.UNREACHABLE, f"{failure.what}; {failure.hint}", None
    except MotionRefused as failure:
        retreat(attempt.context, attempt)
        return Outcome.UNREACHABLE, failure.what, None
    finally:
        attempt.context = attempt.context.forgetting(object_name)
