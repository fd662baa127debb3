"""The tables of a sweep: verdicts by control with Wilson's bounds, forces, and failures by cause with their seeds."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from service.sweep.ask import PanelRun
from service.sweep.deeds import ROWS
from service.sweep.judge import JudgedDeed, Verdict

Z_95 = 1.96
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
SHOWN_SEEDS = 12


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a proportion (Wilson, JASA 22, 1927)."""
    if trials == 0:
        return 0.0, 1.0
    p, z = successes / trials, Z_95
    centre = p + z * z / (2 * trials)
    spread = z * float(np.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials)))
    whole = 1 + z * z / trials
    return max(0.0, (centre - spread) / whole), min(1.0, (centre + spread) / whole)


def report(runs: Sequence[PanelRun]) -> str:
    """Return all tables as Markdown."""
    deeds = [deed for run in runs for deed in run.deeds]
    return "\n\n".join([verdicts(deeds), forces(deeds), causes(deeds), totals(runs)]) + "\n"


def verdicts(deeds: Sequence[JudgedDeed]) -> str:
    """Return the verdicts by control."""
    lines = [
        "| control | right and said so | at least (Wilson) | typed failure | **said done and was not** | right, not said |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in ROWS:
        of_row = [deed for deed in deeds if deed.row == row]
        if of_row:
            counts = Counter(deed.verdict for deed in of_row)
            right, n = counts[Verdict.RIGHT], len(of_row)
            others = " | ".join(str(counts[verdict]) for verdict in (Verdict.FAILED, Verdict.FALSE, Verdict.UNSAID))
            lines.append(f"| {row} | {right} of {n} | {100 * wilson(right, n)[0]:.1f} % | {others} |")
    return "\n".join(lines)


def forces(deeds: Sequence[JudgedDeed]) -> str:
    """Return forces and times by kind."""
    lines = [
        "| kind | peak N, median | p99 | largest | above 100 N | chatter N, median | largest | cell s, median |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for kind in dict.fromkeys(sorted(deed.kind for deed in deeds)):
        of_kind = [deed for deed in deeds if deed.kind == kind]
        peaks, chatter = [deed.peak_n for deed in of_kind], [deed.chatter_n for deed in of_kind]
        lines.append(
            f"| {kind} | {np.median(peaks):.0f} | {np.quantile(peaks, 0.99):.0f} | {max(peaks):.0f} "
            f"| {sum(peak > 100.0 for peak in peaks)} | {np.median(chatter):.1f} | {max(chatter):.1f} "
            f"| {np.median([deed.cell_s for deed in of_kind]):.1f} |"
        )
    return "\n".join(lines)


def causes(deeds: Sequence[JudgedDeed]) -> str:
    """Return the deeds that were not right, by control, verdict and cause, with the seeds that repeat them."""
    groups: dict[tuple[str, str, str, str], list[JudgedDeed]] = defaultdict(list)
    for deed in deeds:
        if deed.verdict is not Verdict.RIGHT:
            groups[deed.row, deed.verdict, deed.outcome, NUMBER.sub("#", deed.cause)].append(deed)
    lines = ["| control | verdict | outcome | cause | times | cause is true | seeds |", "| --- |" + " --- |" * 6]
    for (row, verdict, outcome, _), group in sorted(
        groups.items(), key=lambda item: (ROWS.index(item[0][0]), -len(item[1]))
    ):
        seeds = ", ".join(str(deed.seed) for deed in group[:SHOWN_SEEDS])
        true = sum(bool(deed.cause_is_true) for deed in group)
        cause = group[0].cause.replace("|", "/")
        lines.append(f"| {row} | {verdict} | {outcome} | {cause} | {len(group)} | {true} | {seeds} |")
    return "\n".join(lines)


def totals(runs: Sequence[PanelRun]) -> str:
    """Return what is counted over all deeds, and the panels on which nothing could be done."""
    deeds = [deed for run in runs for deed in run.deeds]
    wrong = [deed for deed in deeds if deed.verdict is not Verdict.RIGHT]
    lines = [
        f"- panels: {len(runs)}; deeds: {len(deeds)}",
        f"- all deeds right: {sum(bool(run.deeds) and _all_right(run) for run in runs)} of {len(runs)} panels",
        f"- said done and was not: {sum(deed.verdict is Verdict.FALSE for deed in deeds)}",
        f"- failures that name a true cause: {sum(bool(deed.cause_is_true) for deed in wrong)} of {len(wrong)}",
        f"- moved unasked: {_listed(deeds, 'moved_unasked')}",
        f"- touched unasked above 10 N: {_listed(deeds, 'touched_unasked')}",
        f"- above 100 N: {_list([f'{deed.seed} {deed.row} {deed.peak_n:.0f} N' for deed in deeds if deed.peak_n > 100])}",
    ]
    if times := [run.cell_s for run in runs if run.deeds]:
        lines.append(f"- a panel on the cell's clock, median: {np.median(times):.1f} s")
    if given := sum(run.readings[1] for run in runs):
        lines.append(f"- readings right: {sum(run.readings[0] for run in runs)} of {given}")
    lines += [f"- seed {run.seed}: {run.problem}" for run in runs if run.problem]
    return "\n".join(lines)


def _all_right(run: PanelRun) -> bool:
    return all(deed.verdict is Verdict.RIGHT for deed in run.deeds)


def _listed(deeds: Sequence[JudgedDeed], key: str) -> str:
    return _list([f"{deed.seed} {deed.row}: {', '.join(getattr(deed, key))}" for deed in deeds if getattr(deed, key)])


def _list(items: Sequence[str]) -> str:
    return f"{len(items)}" + (f" ({'; '.join(items)})" if items else "")
