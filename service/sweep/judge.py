"""Judges one deed of a sweep by the simulator's truth: was it right, was it said so, and was the failure's cause true."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from hal.panel import NumberGoal, Panel, PanelObject
from hal.simulated import ObjectTruth, Truth
from service.evaluate import shown_of
from service.sweep.deeds import Deed

TOUCHED_N = 10.0  # a larger force on a part that was not named counts
MOVED_SHARE = 0.3  # of the tolerance: a control that moved more was moved


class Verdict(StrEnum):
    """How a deed ended, by the report and by the truth."""

    RIGHT = "right and said so"
    FAILED = "typed failure"
    FALSE = "said done and was not"
    UNSAID = "right, but not said"


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedDeed:
    """One deed with its report and the verdict.

    Attributes:
        outcome: of the skill, or the type of the problem with which the task failed.
        cause: as reported; empty for a deed that was done.
        cause_is_true: whether the reported outcome agrees with what truly happened; None for a deed that was right.
        before, after: the true states.
        moved_unasked, touched_unasked: other parts that moved, or took more than `TOUCHED_N`.
        peak_n, impulse_n_s, chatter_n: of the true contact force.
        said_peak_n: largest force by the report.
        cell_s: duration on the cell's clock with looking.
    """

    seed: int
    object: str
    kind: str
    row: str
    goal: str
    verdict: Verdict
    outcome: str
    cause: str
    cause_is_true: bool | None
    before: str
    after: str
    moved_unasked: tuple[str, ...]
    touched_unasked: tuple[str, ...]
    peak_n: float
    impulse_n_s: float
    chatter_n: float
    said_peak_n: float
    attempts: int
    cell_s: float

    @property
    def is_right(self) -> bool:
        """Whether it was right and said so."""
        return self.verdict is Verdict.RIGHT

    @property
    def is_untrue(self) -> bool:
        """Whether it was said to be done and was not, or moved what was not named."""
        return self.verdict is Verdict.FALSE or bool(self.moved_unasked)

    def line(self) -> str:
        """Return the deed as one line of text."""
        extra = "".join(f"; {name} MOVED UNASKED" for name in self.moved_unasked)
        extra += "".join(f"; touched {name}" for name in self.touched_unasked)
        return (
            f"{self.seed:4} {self.row:17} {self.verdict.name:7} {self.outcome:12} to {self.goal}: {self.before} -> "
            f"{self.after}, tries {self.attempts}, peak {self.peak_n:.0f} N, chatter {self.chatter_n:.1f} N, "
            f"{self.cell_s:.1f} s {self.cause}{extra}"
        )


def judge(
    seed: int,
    deed: Deed,
    panel: Panel,
    answer: Mapping[str, Any],
    truth: Truth,
    *,
    worked: frozenset[str] = frozenset(),
) -> JudgedDeed:
    """Judge a deed.

    Args:
        worked: parts that other deeds of the same time were about.
        panel: the panel as built.
        answer: `outcome`, `cause`, `confirmed`, `attempts`, `peak_force_n` of the report.
        truth: with the states before the deed as `initial`.
    """
    one = panel.object(deed.object)
    before = {item.name: item for item in truth.initial}
    after = {item.name: item for item in truth.objects}
    worked |= {one.name, one.shown_by}
    reached = is_reached(one, deed.goal, after)
    verdict = verdict_of(deed, str(answer["outcome"]), reached=reached, is_said=bool(answer["confirmed"]))
    return JudgedDeed(
        seed=seed,
        object=deed.object,
        kind=deed.kind,
        row=deed.row,
        goal=f"{deed.goal:g}" if isinstance(deed.goal, float) else deed.goal,
        verdict=verdict,
        outcome=str(answer["outcome"]),
        cause=str(answer["cause"]),
        cause_is_true=None
        if verdict is Verdict.RIGHT
        else is_true_cause(str(answer["outcome"]), one, deed, before=before, after=after, peak_n=truth.contact.peak_n),
        before=_text(before[one.shown_by]),
        after=_text(after[one.shown_by]),
        moved_unasked=_moved(worked, panel, before, after),
        touched_unasked=tuple(
            sorted(
                name
                for name, peak_n in truth.contact.peaks_n.items()
                if peak_n > TOUCHED_N and name not in worked | {"_plate"}
            )
        ),
        peak_n=truth.contact.peak_n,
        impulse_n_s=truth.contact.impulse_n_s,
        chatter_n=truth.contact.chatter_n,
        said_peak_n=float(answer["peak_force_n"]),
        attempts=int(answer["attempts"]),
        cell_s=float(answer["cell_s"]),
    )


def verdict_of(deed: Deed, outcome: str, *, reached: bool, is_said: bool) -> Verdict:
    """Return the verdict on a deed; a lever that is too stiff is right when it is named so, or turned all the same."""
    if is_said:
        return Verdict.RIGHT if reached else Verdict.FALSE
    if outcome == "stiff" and (deed.must_be_stiff or deed.may_be_stiff) and not reached:
        return Verdict.RIGHT
    return Verdict.UNSAID if reached else Verdict.FAILED


def is_reached(one: PanelObject, goal: str | float, after: Mapping[str, ObjectTruth]) -> bool:
    """Return whether the object that shows the effect truly shows the goal."""
    return one.goal is not None and one.goal.is_reached(goal, shown_of(after[one.shown_by]))


def is_true_cause(
    outcome: str,
    one: PanelObject,
    deed: Deed,
    *,
    before: Mapping[str, ObjectTruth],
    after: Mapping[str, ObjectTruth],
    peak_n: float,
) -> bool:
    """Return whether an outcome that is not right agrees with what happened; a coarse check of its type only."""
    was, now = before[one.shown_by], after[one.shown_by]
    reached, moved = is_reached(one, deed.goal, after), has_moved(one, was, now)
    match outcome:
        case "done":
            return reached
        case "stiff":  # it needs more than is allowed, which the deed knows
            return not moved and (deed.must_be_stiff or deed.may_be_stiff)
        case "missed":
            return not moved and not reached
        case "unreachable":
            return not moved and peak_n < TOUCHED_N
        case "slipped" | "stalled":
            return not reached and peak_n > 0.0
        case "force_limit":
            return not reached and peak_n > 0.5 * 100.0
        case _:
            return outcome not in ("unverified",) and not reached


def has_moved(one: PanelObject, was: ObjectTruth, now: ObjectTruth) -> bool:
    """Return whether a control moved by more than a part of its tolerance, or changed its state."""
    if was.state != now.state:
        return True
    if isinstance(one.goal, NumberGoal) and was.value is not None and now.value is not None:
        return abs(now.value - was.value) > MOVED_SHARE * one.goal.tolerance
    return False


def _moved(
    worked: frozenset[str], panel: Panel, before: Mapping[str, ObjectTruth], after: Mapping[str, ObjectTruth]
) -> tuple[str, ...]:
    """Return the objects that changed although neither they nor a control that they belong to was operated."""
    return tuple(
        name
        for name, was in before.items()
        if name not in worked and not panel.object(name).is_right(shown_of(was), shown_of(after[name]))
    )


def _text(truth: ObjectTruth) -> str:
    if truth.state is not None:
        return truth.state
    return truth.text or ("?" if truth.value is None else f"{truth.value:.4g}")
