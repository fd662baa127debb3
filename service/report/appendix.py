"""The appendix of a report: how the panel was found, what was measured, all pictures, steps and calibrations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from service.report.blocks import Appendix, Block, Cell, Figures, Heading, Table, Text, label_in, mark

Summary = dict[str, Any]


def appendix(r: Summary, captions: dict[str, str]) -> Iterator[Block]:
    """Yield the blocks of the appendix."""
    yield Appendix()
    yield from _judge(r)
    yield from _pose(r)
    yield from _surfaces(r)
    yield from _depths(r)
    yield from _forces(r)
    yield from _all_readings(r)
    yield Heading("All pictures")
    yield Figures(tuple((name, captions[name]) for name in r["pictures"]), across=2)
    yield Heading("Steps and their times")
    steps = [(s["name"], f"{s['cell_s']:.2f}", f"{s['wall_s']:.2f}", s["detail"]) for s in r["steps"]]
    yield Table(("step", "cell's clock, s", "wall clock, s", ""), _plain(steps), numbers={1, 2})
    yield from _origin(r)


def _judge(r: Summary) -> Iterator[Block]:
    if "judge" not in r:
        return
    judge = r["judge"]
    yield Heading("The simulator's truth")
    yield Text(
        "The simulator was asked for the truth after the mission had ended. Nothing in the mission used it.", "soft"
    )
    if judge["pose_error_m"] is not None:
        inside = "inside" if judge["inside_95"] else "outside"
        yield Text(
            f"Error of the panel's pose: {_mm(judge['pose_error_m'])} mm, {_deg(judge['pose_error_rad'])}°; "
            f"{inside} of the stated 95 % ellipsoid.",
            "ok" if judge["inside_95"] else "bad",
        )
    for moved in judge.get("moved_unasked", []):
        yield Text(f"{label_in(r, moved['name'])} changed although it was not operated: {moved['truth']}.", "bad")
    rows = tuple(
        (
            Cell(label_in(r, c["name"])),
            Cell(c["what"], "soft"),
            Cell(str(c["claimed"])),
            Cell(str(c["truth"])),
            mark("right" if c["right"] else "WRONG", is_good=c["right"]),
        )
        for c in judge["claims"]
    )
    yield Table(("object", "what", "report says", "truth", "verdict"), rows)


def _pose(r: Summary) -> Iterator[Block]:
    fused = r.get("fused")
    if not fused:
        return
    yield Heading("Pose of the panel")
    at, sigma = (", ".join(_mm(v) for v in fused[key]) for key in ("translation_m", "sigma_m"))
    turn = ", ".join(_deg(v) for v in fused["sigma_rad"])
    yield Text(
        f"The panel stands at ({at}) mm from the base of the arm, one standard deviation ({sigma}) mm and ({turn})°. "
        f"Chi-square {fused['chi_square']:.1f} on {fused['dof']} degrees of freedom."
    )
    rows = tuple(
        (
            Cell(m["label"]), Cell(m["sensor"], "soft"), Cell(m["sensing"], "soft"), Cell(f"{m['value']:.2f}"),
            Cell(str(m["dof"])), Cell("rejected", "bad") if m["rejected"] else Cell("used"),
        )
        for m in fused["measurements"]
    )  # fmt: skip
    yield Table(("measurement", "sensor", "class", "f", "degrees", "status"), rows, numbers={3, 4})
    touching = fused.get("touching")
    if touching:
        for touch in touching["touches"]:
            yield Text(touch["words"])
        skipped = "".join(f" Not touched: {place}." for place in touching["skipped"])
        yield Text(f"Touching ended: {touching['ended']}.{skipped}", "soft")


def _surfaces(r: Summary) -> Iterator[Block]:
    if not r.get("by_surfaces"):
        return
    yield Heading("Comparison with the range image")
    yield Text(
        "These objects were found by their surfaces in the range image, independently of the camera, and compared with "
        "the panel file. An object that is in another place is scanned again from closer, and not operated.",
        "soft",
    )
    rows = tuple(
        (
            Cell(label_in(r, c["name"])), Cell(c["seen_from"], "soft"), Cell(_mm(c["off_m"])), Cell(_mm(c["sigma_m"])),
            Cell(_mm(c["off_vision_m"])), mark(c["finding"], is_good=c["agrees"]),
        )
        for c in r["by_surfaces"]
    )  # fmt: skip
    columns = ("object", "seen from", "off the panel file, mm", "1 sigma, mm", "off vision, mm", "finding")
    yield Table(columns, rows, numbers={2, 3, 4})


def _depths(r: Summary) -> Iterator[Block]:
    if not r.get("depths"):
        return
    yield Heading("Depths by several views")
    rows = tuple(
        (
            Cell(label_in(r, d["name"])), Cell(str(d["views"])), Cell(_mm(d["depth_m"])), Cell(_mm(d["sigma_m"])),
            Cell(_mm(d["stated_m"])), Cell(d["finding"], "bad" if d["contradicts"] else ""),
        )
        for d in r["depths"]
    )  # fmt: skip
    columns = ("object", "views", "stands out, mm", "1 sigma, mm", "panel file, mm", "finding")
    yield Table(columns, rows, numbers={1, 2, 3, 4})


def _forces(r: Summary) -> Iterator[Block]:
    if not r["actions"]:
        return
    yield Heading("Work at the controls")
    rows = [
        (
            label_in(r, a["object"]), a["skill"], f"{a['peak_force_n']:.1f}", f"{a['impulse_n_s'] or 0:.1f}",
            f"{a['chatter_n'] or 0:.1f}", str(a["attempts"]), f"{a['cell_s']:.1f}",
        )
        for a in r["actions"]
    ]  # fmt: skip
    columns = ("object", "skill", "largest force, N", "impulse, N s", "chatter, N", "tries", "time, s")
    yield Table(columns, _plain(rows), numbers={2, 3, 4, 5, 6})


def _all_readings(r: Summary) -> Iterator[Block]:
    if not r["readings"]:
        return
    yield Heading("All readings of this mission")
    rows = [
        (
            label_in(r, x["name"]),
            x["kind"].replace("_", " "),
            x["shows"],
            f"{x['confidence']:.2f}",
            x["when"],
            x["reason"] or "",
        )
        for x in r["readings"]
    ]
    yield Table(("object", "kind", "shows", "confidence", "when", "reason"), _plain(rows), numbers={3})


def _origin(r: Summary) -> Iterator[Block]:
    """Yield with what the mission was done: versions and calibrations."""
    yield Heading("Versions and calibrations")
    seed = f", seed {r['seed']}" if r["mode"] == "sim" else ""
    version = r.get("version", "of unknown version")
    yield Text(f"panelwright {version}; cell file {r['cell']} ({r['mode']}{seed}); mission {r['mission']}.")
    records = [(one["device"], one["date"], one["method"]) for one in r.get("calibrations") or []]
    if records:
        yield Table(("device", "calibrated", "method"), _plain(records))


def _plain(rows: Sequence[tuple[str, ...]]) -> tuple[tuple[Cell, ...], ...]:
    return tuple(tuple(Cell(text) for text in row) for row in rows)


def _mm(metres: float | None) -> str:
    return "" if metres is None else f"{1e3 * metres:.2f}"


def _deg(radians: float) -> str:
    return f"{math.degrees(radians):.3f}"
