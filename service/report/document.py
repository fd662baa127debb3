"""What a report says, as blocks in their order, from `report.json`: the main part for everybody, then the appendix.

The page and the PDF are made from the same blocks.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from service.report.appendix import appendix
from service.report.blocks import Block, Cell, Facts, Figures, Heading, Table, Text, Title, label_in, mark

Summary = dict[str, Any]
CLOSE_UPS = ("read-", "look-", "recognised-", "pose")


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What a folder of a mission has: its summary, and the caption of each picture by file name."""

    summary: Summary
    captions: dict[str, str]


def blocks_of(report: Report) -> Iterator[Block]:
    """Yield the blocks of a report."""
    r = report.summary
    yield from _head(r)
    yield from _actions(r)
    yield from _readings(r)
    yield from _pictures(report)
    yield from appendix(r, report.captions)


def _head(r: Summary) -> Iterator[Block]:
    site = "simulated cell" if r["mode"] == "sim" else "cell"
    title = r.get("title") or "Mission"
    yield Title(f"{title}: panel {r['panel']}", f"{site} {r['cell']}, {_moment(r['started'])}")
    alarms = r.get("alarms") or []
    verdict = "Everything was done and confirmed" if r["succeeded"] else "Not everything was done"
    told = "no alarm" if not alarms else "1 alarm" if len(alarms) == 1 else f"{len(alarms)} alarms"
    yield Text(f"{verdict}; {told}", "verdict ok" if r["succeeded"] and not alarms else "verdict bad")
    if r.get("problem"):
        yield Text(f"{r['problem']['title']}: {r['problem']['detail']}", "bad")
        yield Text(f"Try: {r['problem']['hint']}", "soft")
    if r.get("not_parked"):
        yield Text(f"Not parked: {r['not_parked']}", "bad")
    for one in alarms:
        todo = f" {one['what_to_do']}" if one["what_to_do"] else ""
        yield Text(f"{one['priority'].capitalize()} alarm, {label_in(r, one['object'])}: {one['says']}.{todo}", "bad")
    if "judge" in r:
        agrees = r["judge"]["agrees"]
        truth = "The simulator was asked for the truth afterwards: it"
        told = f"{truth} agrees with every claim." if agrees else f"{truth} disagrees; see the appendix."
        yield Text(told, "ok" if agrees else "bad")
    given = [one for one in r["readings"] if one["reason"] is None]
    yield Facts(
        (
            (r.get("asked_by") or "not recorded", "asked for it"),
            (f"{sum(one['confirmed'] for one in r['actions'])} of {len(r['actions'])}", "actions confirmed"),
            (f"{len(given)} of {len(r['readings'])}", "readings given"),
            (f"{r['cell_s']:.0f} s", "on the cell's clock"),
            (f"{r['peak_force_n']:.1f} N", "largest contact force"),
        )
    )
    undone = [one for one in r.get("mission_steps") or [] if one["outcome"] not in ("done", "taken over")]
    if undone:
        yield Heading("Steps that were not done")
        yield Table(
            ("step", "outcome", "why"),
            tuple((Cell(one["path"]), Cell(one["outcome"], "bad"), Cell(one["detail"])) for one in undone),
        )


def _actions(r: Summary) -> Iterator[Block]:
    if not r["actions"]:
        return
    yield Heading("Actions")
    rows = []
    for one in r["actions"]:
        outcome = f"{one['outcome']}, {'confirmed' if one['confirmed'] else 'NOT confirmed'}"
        why = f": {one['detail']}" if one["detail"] else ""
        rows.append(
            (
                Cell(label_in(r, one["object"])), Cell(one["target"]), Cell(one["before"]), Cell(one["after"]),
                mark(outcome + why, is_good=one["confirmed"]), Cell(f"{one['peak_force_n']:.1f}"),
            )
        )  # fmt: skip
    yield Table(("object", "told to be", "before", "after", "outcome", "largest force, N"), tuple(rows), numbers={5})


def _readings(r: Summary) -> Iterator[Block]:
    """Yield the newest reading of each object beside the one before this mission."""
    newest = {one["name"]: one for one in r["readings"]}
    if not newest:
        return
    yield Heading("Readings")
    before, crops = r.get("previous") or {}, r.get("crops") or []
    rows = []
    for name, one in newest.items():
        earlier, picture = before.get(name), f"crop-{name}.png"
        is_given = one["reason"] is None
        has_interval = is_given and one["uncertainty"] is not None and one["state"] is None
        row = (
            Cell(picture=picture if picture in crops else None),
            Cell(label_in(r, name)),
            Cell(words(one)) if is_given else Cell(f"not readable: {one['reason']}", "bad"),
            Cell(f"± {_number(1.96 * one['uncertainty'], one)}" if has_interval else ""),
            Cell(f"{100 * one['confidence']:.0f} %" if is_given else ""),
            Cell("" if earlier is None else f"{words(earlier)}  ({_moment_s(earlier['utc_s'])})", "soft"),
            Cell(_change(one, earlier) if is_given and earlier is not None else ""),
        )
        rows.append(row)
    columns = ("", "object", "shows", "95 %", "confidence", "before this mission", "change")[: 7 if before else 5]
    yield Table(columns, tuple(row[: len(columns)] for row in rows))


def _pictures(report: Report) -> Iterator[Block]:
    chosen = [
        name for name in report.summary["pictures"] if name.startswith(CLOSE_UPS) and not name.startswith("recognised-")
    ]
    if chosen:
        yield Heading("Pictures")
        yield Figures(tuple((name, report.captions[name]) for name in chosen[:6]), across=3)


def words(one: dict[str, Any]) -> str:
    """Return what an object shows in the terms of people: its state, its digits or its value, angles in degrees."""
    if one["state"] is not None:
        return str(one["state"])
    unit = {"rad": "°", "degC": " °C"}.get(one["unit"], f" {one['unit']}" if one["unit"] else "")
    if one["text"] is not None:
        return f"{one['text'].strip()}{unit}"
    return "–" if one["value"] is None else f"{_number(one['value'], one)}{unit}"


def _number(value: float, one: dict[str, Any]) -> str:
    """Return a number to the first digit of its standard deviation, an angle in degrees."""
    factor = math.degrees(1.0) if one["unit"] == "rad" else 1.0
    step = factor * (one["uncertainty"] or abs(one["value"] or 1.0) / 1000 or 1.0)
    digits = max(0, min(4, -math.floor(math.log10(step))))
    return f"{factor * value:.{digits}f}"


def _change(one: dict[str, Any], earlier: dict[str, Any]) -> str:
    if one["value"] is None or earlier["value"] is None or one["state"] is not None:
        return "" if words(one) == words(earlier) else "changed"
    change = one["value"] - earlier["value"]
    return f"{'+' if change >= 0 else '−'}{_number(abs(change), one)}"


def _moment(iso: str) -> str:
    return iso.replace("T", " ").replace("Z", " UTC")


def _moment_s(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.gmtime(seconds))
