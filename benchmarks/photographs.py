"""Prints what is read in photographs of single instruments: `python -m benchmarks.photographs [SEED [COUNT]]`.

Each line gives a set's size, and how many of its readings are right, refused, wrong, and sure (a confidence of 0.8 or
more) and wrong, beside the share right that is to be reached. First come the photographs with known readings beside the
repository, then COUNT (default 60) drawn photographs of each kind from SEED on. A dial is right within 2 % of its
scale, a gauge within 2.5 %, a display if its text is exact.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.display_drawing import PHOTOGRAPHS, draw_photograph
from benchmarks.photograph_scenes import draw_scene, draw_without
from benchmarks.printed_text import Print
from benchmarks.vision_dials import DrawnDial, draw_dial
from benchmarks.vision_manometers import USUAL, Way, draw_manometer
from hal.arrays import Image
from hal.errors import CellError
from perception.vision import decode, read_photograph
from perception.vision.reading import PatchReading

REAL = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "vision" / "real"
SEED, COUNT = 200000, 60
SURE = 0.8
METER_NUMERAL = 0.007  # see `draw_dial`
PRINTED = ("DejaVuSans", "DejaVuSans-Bold", "cmss10", "STIXGeneral", "DejaVuSansMono", "cmb10", "DejaVuSerif")
FACE_SHARE, LEGIBLE_PX = 0.4, 8.0  # of a face's radius in a picture's side; height of numerals that can be read
DIAL_WITHIN, GAUGE_WITHIN = 0.02, 0.025  # of the scale
PASS = {
    "dials": 0.93, "manometers": 0.95, "counters": 0.40, "told nothing": 0.60, "told the ends": 0.95,
    "told the scale": 0.85, "two pointers": 0.80,
    "cropped": 0.90, "scene": 0.70, "low contrast": 0.40, "minus": 0.70,
}  # fmt: skip

Read = Callable[[Image], PatchReading]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A picture, how it is read, its reading (a value or a text), and by how much a value may be off.

    `circle` is the length of a scale that is a full turn.
    """

    image: Image
    read: Read
    truth: float | str
    within: float = 0.0
    circle: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Number of cases, and of those right, refused, wrong, and sure and wrong."""

    cases: int
    right: int
    refused: int
    wrong: int
    sure_wrong: int


def tally(cases: Iterable[Case]) -> Tally:
    """Read all cases and count."""
    counts: list[tuple[bool, bool, float]] = []
    for case in cases:
        try:
            found = case.read(case.image)
        except CellError:
            counts.append((False, False, 0.0))
            continue
        counts.append((found.answered, _is_right(case, found), found.confidence))
    wrong = [confidence for answered, right, confidence in counts if answered and not right]
    return Tally(
        cases=len(counts), right=sum(right for _, right, _ in counts), refused=sum(not answered for answered, _, _ in counts),
        wrong=len(wrong), sure_wrong=sum(confidence >= SURE for confidence in wrong),
    )  # fmt: skip


def _is_right(case: Case, found: PatchReading) -> bool:
    if not found.answered:
        return False
    if isinstance(case.truth, str):
        return (found.text or "").replace(" ", "") == case.truth.replace(" ", "")
    if found.value is None:
        return False
    off = abs(found.value - case.truth)
    if case.circle is not None:
        off = min(off % case.circle, case.circle - off % case.circle)
    return off <= case.within


def _gauge(image: Image, **told: Any) -> PatchReading:
    return read_photograph(image, "gauge", **told)


def _dial(image: Image, scale: tuple[float, float]) -> PatchReading:
    return read_photograph(image, "dial", scale=scale)


def _display(image: Image, is_scene: bool) -> PatchReading:
    return read_photograph(image, "display", is_scene=is_scene)


def real_sets(folder: Path) -> dict[str, tuple[float, list[Case]]]:
    """Return the sets of real photographs, each with the share right that is to be reached."""
    sets: dict[str, tuple[float, list[Case]]] = {
        "real: water-meter dials": (PASS["dials"], []),
        "real: pressure gauge, told the scale": (PASS["manometers"], []),
        "real: drum counters in the scene": (PASS["counters"], []),
    }
    dials, gauges, counters = (cases for _, cases in sets.values())
    for name, entry in json.loads((folder / "truth.json").read_text(encoding="utf-8")).items():
        if entry["kind"] == "panel":
            continue
        image = decode((folder / name).read_bytes())
        if entry["kind"] == "display":
            counters.append(Case(image=image, read=partial(_display, is_scene=True), truth=str(entry["text"])))
            continue
        low, high = float(entry["min"]), float(entry["max"])
        span, is_dial = high - low, bool(entry.get("circular"))
        read: Read = partial(_dial if is_dial else _gauge, scale=(low, high))
        within = span * (DIAL_WITHIN if is_dial else GAUGE_WITHIN)
        truth = float(entry["reading"])
        (dials if is_dial else gauges).append(
            Case(image=image, read=read, truth=truth, within=within, circle=span if is_dial else None)
        )
    return sets


def _ends(way: Way) -> tuple[float, float]:
    return way.angle_rad(0.0), way.angle_rad(1.0)


def _drawn_gauges(seeds: range, way_of: Callable[[int], Way], *, ends: bool, scale: tuple[float, float] = (0.0, 10.0),
                  **told: Any) -> Iterator[Case]:  # fmt: skip
    """Yield drawn gauges; `ends`: whether the reader is told where the scale ends."""
    for seed in seeds:
        way = way_of(seed)
        drawn = draw_manometer(seed, way)
        given = {"scale": scale, **told, **({"ends_rad": _ends(way)} if ends else {})}
        truth = drawn.red if told.get("pointer") == "red" and drawn.red is not None else drawn.reading
        yield Case(image=drawn.image, read=partial(_gauge, **given), truth=truth, within=10 * GAUGE_WITHIN)


def printed_way(seed: int) -> Way:
    """Return a usual sweep with numerals of a font of matplotlib, the same for the same seed; a third point outwards."""
    rng = np.random.default_rng((seed, 7))
    how = Print(
        font=str(rng.choice(PRINTED)), height=float(rng.uniform(0.08, 0.14)), is_radial=bool(rng.random() < 0.35)
    )
    return Way(print=how)


def _printed_gauges(seeds: range, *, scale: bool) -> Iterator[Case]:
    """Yield drawn gauges whose numerals have `LEGIBLE_PX` at least; `scale`: whether the reader is told the scale."""
    for seed in seeds:
        way = printed_way(seed)
        drawn = draw_manometer(seed, way)
        if way.print is not None and way.print.height * FACE_SHARE * min(drawn.image.shape[:2]) >= LEGIBLE_PX:
            read = partial(_gauge, scale=(0.0, drawn.full)) if scale else _gauge
            truth = drawn.reading / 10 * drawn.full
            yield Case(image=drawn.image, read=read, truth=truth, within=GAUGE_WITHIN * drawn.full)


def _gauges_anywhere(seeds: range, *, scale: bool) -> Iterator[Case]:
    """Yield gauges somewhere in a picture, with legible numerals also where they are foreshortened."""
    for seed in seeds:
        way = printed_way(seed)
        scene = draw_scene(seed, way)
        if way.print is not None and way.print.height * 0.5 * scene.width_px * np.cos(scene.tilt_rad) >= LEGIBLE_PX:
            read = partial(read_photograph, scale=(0.0, scene.full)) if scale else read_photograph
            truth = scene.reading / 10 * scene.full
            yield Case(image=scene.image, read=read, truth=truth, within=GAUGE_WITHIN * scene.full)


def _nothing_anywhere(seeds: range) -> Iterator[Case]:
    """Yield pictures without an instrument, where no answer is right."""
    for seed in seeds:
        yield Case(image=draw_without(seed), read=read_photograph, truth=float("nan"))


def any_way(seed: int) -> Way:
    """Return a sweep of 40 to 340 degrees, turned by up to 20 degrees, the same for the same seed."""
    rng = np.random.default_rng((seed, 5))
    return Way(
        span_rad=float(np.deg2rad(rng.uniform(40.0, 340.0))), turned_rad=float(np.deg2rad(rng.uniform(-20.0, 20.0)))
    )


def _drawn_dials(
    seeds: range, *, falls: bool, scale: tuple[float, float], numeral: float = METER_NUMERAL
) -> Iterator[Case]:
    for seed in seeds:
        drawn: DrawnDial = draw_dial(seed, falls=falls, circular=True, numeral=numeral)
        yield Case(image=drawn.image, read=partial(_dial, scale=scale), truth=drawn.reading, within=10 * DIAL_WITHIN,
                   circle=10.0)  # fmt: skip


def _drawn_displays(seeds: range, kind: str, *, negative: bool = False, is_told: bool = True) -> Iterator[Case]:
    for seed in seeds:
        drawn = draw_photograph(seed, kind)
        if negative and not drawn.text.startswith("-"):
            continue
        read = partial(_display, is_scene=kind == "scene") if is_told else read_photograph
        yield Case(image=drawn.image, read=read, truth=drawn.text)


def drawn_sets(first: int, count: int) -> Iterator[tuple[str, float, Iterable[Case]]]:
    """Yield the drawn sets: name, share right that is to be reached, and cases."""
    seeds = range(first, first + count)
    usual = partial(_always, USUAL)
    red = partial(_always, Way(has_red=True))
    falling = partial(_always, Way(falls=True))
    printed = range(first, first + 2 * count)
    yield "drawn: printed gauges, told nothing", PASS["told nothing"], _printed_gauges(printed, scale=False)
    yield "drawn: printed gauges, told the scale", PASS["told the scale"], _printed_gauges(printed, scale=True)
    yield "drawn: gauges anywhere, told nothing", PASS["told nothing"], _gauges_anywhere(printed, scale=False)
    yield "drawn: gauges anywhere, told the scale", PASS["told the scale"], _gauges_anywhere(printed, scale=True)
    yield "drawn: pictures without an instrument", 0.0, _nothing_anywhere(seeds)
    for kind in PHOTOGRAPHS:
        yield f"drawn: displays, {kind}, kind not told", 0.0, _drawn_displays(seeds, kind, is_told=False)
    yield "drawn: gauges, told the scale", PASS["told the scale"], _drawn_gauges(seeds, usual, ends=False)
    yield "drawn: gauges, told the ends", PASS["told the ends"], _drawn_gauges(seeds, usual, ends=True)
    yield "drawn: 40 to 340 deg, turned, scale", 0.0, _drawn_gauges(seeds, any_way, ends=False)
    yield "drawn: 40 to 340 deg, turned, ends", PASS["told the ends"], _drawn_gauges(seeds, any_way, ends=True)
    yield (
        "drawn: falling gauges, told so",
        PASS["told the scale"],
        _drawn_gauges(seeds, falling, ends=False, scale=(10.0, 0.0)),
    )
    yield "drawn: falling gauges, not told", 0.0, _drawn_gauges(seeds, falling, ends=False)
    for pointer in ("black", "red"):
        cases = _drawn_gauges(seeds, red, ends=True, pointer=pointer)
        yield f"drawn: two pointers, {pointer} asked", PASS["two pointers"], cases
    yield "drawn: two pointers, none asked", 0.0, _drawn_gauges(seeds, red, ends=True)
    yield "drawn: dials", PASS["dials"], _drawn_dials(seeds, falls=False, scale=(0.0, 10.0))
    yield "drawn: falling dials, told so", PASS["dials"], _drawn_dials(seeds, falls=True, scale=(10.0, 0.0))
    yield "drawn: falling dials, not told", 0.0, _drawn_dials(seeds, falls=True, scale=(0.0, 10.0))
    tiny = _drawn_dials(seeds, falls=True, scale=(0.0, 10.0), numeral=0.0022)
    yield "drawn: falling dials, tiny numerals", 0.0, tiny
    for kind in PHOTOGRAPHS:
        yield f"drawn: displays, {kind}", PASS[kind], _drawn_displays(seeds, kind)
    many = range(first, first + 4 * count)
    yield "drawn: displays with a minus", PASS["minus"], _drawn_displays(many, "cropped", negative=True)


def _always(way: Way, _seed: int) -> Way:
    return way


def line(name: str, least: float, counted: Tally) -> str:
    """Return the line of a set."""
    share = counted.right / max(1, counted.cases)
    wanted = f">= {least:.2f} {'pass' if share >= least else 'MISS'}" if least else ""
    return (
        f"{name:38s} {counted.cases:4d} {counted.right:6d} {counted.refused:7d} {counted.wrong:6d} {counted.sure_wrong:6d}"
        f"   {share:.2f} {wanted}"
    )


def main(arguments: list[str]) -> int:
    """Print the table; return 1 if anything in it is sure and wrong."""
    cv2.setNumThreads(1)
    first = int(arguments[0]) if arguments else SEED
    count = int(arguments[1]) if len(arguments) > 1 else COUNT
    print(f"{'set':38s} {'all':>4s} {'right':>6s} {'refused':>7s} {'wrong':>6s} {'sure':>6s}   share")
    sure = 0
    if REAL.is_dir():
        for name, (least, cases) in real_sets(REAL).items():
            counted = tally(cases)
            sure += counted.sure_wrong
            print(line(name, least, counted), flush=True)
    else:
        print("the photographs are not beside the repository: only drawn ones are read")
    for name, least, drawn in drawn_sets(first, count):
        counted = tally(drawn)
        sure += counted.sure_wrong
        print(line(name, least, counted), flush=True)
    print(f"sure and wrong: {sure}; drawn with the seeds {first} to {first + count - 1}")
    return 1 if sure else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
