"""Measures the benefit of each pass of the range segmentation: every pass is left out in turn, on newly drawn scenes.

python -m benchmarks.range_passes [--first-seed N] [--seeds N] [--only SUBJECT]

Each image is analysed with all passes and once without each pass, so that the comparison is paired. Printed per subject
and pass: how many more regions are right at an overlap of 0.8 and of 0.9 (Hoover et al., IEEE PAMI 18(7), 1996) without
the pass, how many more regions are spurious, in how many images the result is worse or better, and the pass's CPU time
relative to the whole chain.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.range import DATA, case_depth, range_module
from benchmarks.range_rooms import VIEWS as ROOM_VIEWS
from benchmarks.range_rooms import room
from benchmarks.range_sensors import SENSORS, table_top
from benchmarks.range_soft import SCENES as SOFT_SCENES
from benchmarks.range_soft import VIEWS as SOFT_VIEWS
from benchmarks.range_soft import soft_scene
from hal.arrays import Labels
from perception.range import analysis, warm_up
from perception.range.recordings import sensor_from_meta
from perception.range.segmentation import fillets, finish, join, merge, segment

MM = 1000.0
Case = dict[str, Any]
Replacement = tuple[ModuleType, str, Any]

WHOLE = "everything"


def handing_back(position: int) -> Callable[..., Any]:
    """Return a replacement for a pass that returns one of its arguments unchanged."""
    return lambda *arguments, **_options: arguments[position]


def none_joined(_regions: Any, kinds: list[int], _parameters: Any) -> list[int]:
    """Replace merging and joining: every region keeps its own label."""
    return list(range(1, len(kinds) + 1))


PASSES: dict[str, tuple[Replacement, ...]] = {
    WHOLE: (),
    "noise widening": ((segment, "WIDENINGS", 0),),
    "finer blocks": ((segment, "_add_small_surfaces", handing_back(2)),),
    "merging neighbours": ((merge, "merge_touching", none_joined),),
    "joining pieces": ((join, "join_pieces", none_joined),),
    "icm": ((analysis, "icm_labels", handing_back(2)),),
    "fillet strips": ((fillets, "_strips", lambda *_arguments: {}),),
    "fillet spreading": ((fillets, "spread_outwards", handing_back(0)),),
    "crumbs": ((finish, "without_crumbs", lambda labels, surfaces, _least: (labels, surfaces)),),
    "small gaps": ((analysis, "fill_small_gaps", handing_back(0)),),
}


@dataclass(slots=True, kw_only=True)
class Tally:
    """Counts per image: regions that are correct at 0.8 and 0.9, regions without a true one, and CPU time."""

    right: list[int] = field(default_factory=list)
    strictly_right: list[int] = field(default_factory=list)
    false: list[int] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, other: Tally) -> None:
        """Append the images of another tally."""
        self.right += other.right
        self.strictly_right += other.strictly_right
        self.false += other.false
        self.seconds += other.seconds


def main() -> None:
    """Run the command line; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=3000)
    parser.add_argument("--seeds", type=int, default=20, help="seeds per subject; half as many of the large images")
    parser.add_argument("--only", choices=SUBJECTS)
    arguments = parser.parse_args()
    gen = range_module("gen")
    warm_up()
    numbers = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    totals = {name: Tally() for name in PASSES}
    for subject, cases in SUBJECTS.items():
        if arguments.only in (None, subject):
            tallies = measured(cases(gen, numbers))
            print_rows(subject, tallies)
            for name, tally in tallies.items():
                totals[name].add(tally)
    print_rows("all", totals)


def measured(cases: Iterator[Case]) -> dict[str, Tally]:
    """Analyse every case with all passes and without each pass in turn."""
    tallies = {name: Tally() for name in PASSES}
    for case in cases:
        depth, sensor = case_depth(case, codes="use" in case), sensor_from_meta(case["meta"]["sensor"], 1 / MM)
        for name, tally in tallies.items():
            with without(name):
                start = time.process_time()
                labels = analysis.analyse(depth, sensor).labels
                tally.seconds += time.process_time() - start
            counts = [counted(case, labels, tolerance) for tolerance in (0.8, 0.9)]
            tally.right.append(counts[0][0])
            tally.strictly_right.append(counts[1][0])
            tally.false.append(counts[0][1])
    return tallies


def counted(case: Case, labels: Labels, tolerance: float) -> tuple[int, int]:
    """Return the numbers of true regions that a found one overlaps by `tolerance` of both, and of spurious regions."""
    truth = np.asarray(case["labels"], np.int64)
    columns = int(labels.max()) + 1
    shared = np.bincount((truth * columns + labels).ravel(), minlength=(int(truth.max()) + 1) * columns)
    shared = shared.reshape(-1, columns)
    of_truth = shared / np.maximum(shared.sum(axis=1, keepdims=True), 1)
    of_found = shared / np.maximum(shared.sum(axis=0), 1)
    is_right = (of_truth >= tolerance) & (of_found >= tolerance)
    scored = [s["id"] for s in case["meta"]["surfaces"] if s["scored"]]
    is_inside = (of_found[1:] >= 0.5).any(axis=0)
    return int(is_right[scored, 1:].any(axis=1).sum()), int((~is_inside[1:]).sum())


@contextmanager
def without(name: str) -> Iterator[None]:
    """Run the `with` block without one pass of `PASSES`."""
    with ExitStack() as stack:
        for module, attribute, stand_in in PASSES[name]:
            stack.enter_context(patch.object(module, attribute, stand_in))
        yield


def print_rows(subject: str, tallies: dict[str, Tally]) -> None:
    """Print one line per pass: what changes if it is left out."""
    whole = tallies[WHOLE]
    print(f"\n{subject}: {len(whole.right)} images, {sum(whole.right)} and {sum(whole.strictly_right)} regions right,")
    print(f"  {sum(whole.false)} false, {1e3 * whole.seconds / max(len(whole.right), 1):.1f} ms per image")
    for name, tally in tallies.items():
        if name == WHOLE:
            continue
        worse = sum(a < b for a, b in zip(tally.right, whole.right, strict=True))
        better = sum(a > b for a, b in zip(tally.right, whole.right, strict=True))
        change = sum(tally.right) - sum(whole.right)
        strict_change = sum(tally.strictly_right) - sum(whole.strictly_right)
        print(
            f"  without {name:<25} {change:+5d} {strict_change:+5d} right, {sum(tally.false) - sum(whole.false):+4d} false,"
            f" {worse:3d} images worse, {better:3d} better, time x {tally.seconds / whole.seconds:.2f}",
            flush=True,
        )


def drawn(scene: str, **kind: Any) -> Callable[[ModuleType, range], Iterator[Case]]:
    """Return a source of cases of a generator's scene; with `use`, 8-bit codes fill that fraction of their range."""

    def cases(gen: ModuleType, numbers: range) -> Iterator[Case]:
        for seed in numbers:
            case = gen.make(scene, seed, **kind)
            yield case | {"meta": json.loads(json.dumps(case["meta"], default=lambda o: o.tolist()))} | kind

    return cases


def seen_by(
    draw: Callable[[ModuleType, str, int], Case], sensors: Sequence[str]
) -> Callable[[ModuleType, range], Iterator[Case]]:
    """Return a source of 640x480 cases for each of the sensors, half as many per sensor as there are seeds."""
    return lambda gen, numbers: (draw(gen, s, n) for s in sensors for n in numbers[: (len(numbers) + 1) // 2])


def living_room(_gen: ModuleType, _numbers: range) -> Iterator[Case]:
    """Yield the only real frame of the development data with known truth."""
    with np.load(DATA / "real" / "icl_living_room_0.npz") as data:
        yield {key: data[key] for key in data.files} | {"meta": json.loads(str(data["meta"]))}


SUBJECTS: dict[str, Callable[[ModuleType, range], Iterator[Case]]] = {
    "fig10": drawn("fig10"),
    "fig10, oblique": drawn("fig10_oblique"),
    "polyhedra": drawn("polyhedra"),
    "polyhedra, noise of 2 mm": drawn("polyhedra", sigma=2.0),
    "curved": drawn("curved"),
    "panel": drawn("panel"),
    "panel 128x128": drawn("panel", n=128),
    "fig10, a quarter of 8 bits": drawn("fig10", use=0.25, sigma=0.25),
    "table tops by depth sensors": seen_by(table_top, SENSORS),
    "bulged and rounded, table": seen_by(lambda gen, s, n: soft_scene(gen, SOFT_SCENES[0], s, n), SOFT_VIEWS),
    "bulged and rounded, room": seen_by(lambda gen, s, n: soft_scene(gen, SOFT_SCENES[1], s, n), SOFT_VIEWS),
    "furnished rooms": seen_by(room, ROOM_VIEWS),
    "living room": living_room,
}


if __name__ == "__main__":
    main()
