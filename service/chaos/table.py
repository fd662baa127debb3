"""The table of a run of chaos: for each fault how often it came, what followed, and the invariants that did not hold."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from service.chaos.options import Round


def report(rounds: Sequence[Round], final: Round) -> str:
    """Return the table by fault and the list of breaches as Markdown."""
    lines = [
        "| fault | times | breaches | tasks ended | followed after s, median and longest | back after s, median and longest |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    by_fault: dict[str, list[Round]] = defaultdict(list)
    for one in rounds:
        by_fault[one.fault].append(one)
    for fault, group in sorted(by_fault.items()):
        ended = Counter(one.ended for one in group if one.ended)
        shown = ", ".join(f"{count} {how}" for how, count in ended.most_common())
        followed = _times([one.followed_s for one in group])
        back = _times([one.back_s for one in group])
        broken = sum(bool(one.breaches) for one in group)
        lines.append(f"| {fault} | {len(group)} | {broken} | {shown} | {followed} | {back} |")
    breaches = [(one, what) for one in (*rounds, final) for what in one.breaches]
    lines += ["", f"{len(rounds)} rounds, {len(breaches)} breaches"]
    lines += [f"- round {one.number}, {one.fault} ({one.what}): {what}" for one, what in breaches]
    return "\n".join(lines) + "\n"


def write(folder: Path, rounds: Sequence[Round], final: Round, *, lines: Sequence[str]) -> list[Path]:
    """Write `chaos.md`, `chaos.json` and the log of the service; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "chaos.md": report(rounds, final),
        "chaos.json": json.dumps([asdict(one) for one in (*rounds, final)], indent=1) + "\n",
        "service.log": "".join(lines),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def _times(seconds: Sequence[float | None]) -> str:
    known = [one for one in seconds if one is not None]
    return f"{np.median(known):.1f}, {max(known):.1f}" if known else ""
