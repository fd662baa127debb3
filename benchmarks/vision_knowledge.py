"""Teaches the shipped kinds from labelled overviews, and tests the result on held-out overviews.

`python -m benchmarks.vision_knowledge FOLDER` prints recall, precision and calibration of three folds of the overviews
beside the repository, then writes one archive (`.npz`) per kind, taught on all overviews, into FOLDER. The shipped
files were made in this way. There is one look per object at its true centre, and there are looks of places without
object; of both only those are kept that the other looks do not recognise with a margin
(`perception.vision.teaching.condense`). Overviews in good light also teach further looks, which are used in noisy
images only: they are degraded by uneven light, glare, shadow, cables, blur and noise (`panel_scene`). With
`--only-noisy` only these are taught, in addition to the shipped looks for all images. The shipped looks for noisy
images were made in this way.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.panel_scene import AMOUNTS, GAMMA, pictured, seen
from hal.arrays import Array, Image
from perception.vision.finding.blind import PLATE_M, Detection, candidate_places, chosen, lay_out
from perception.vision.finding.features import PLATE_PX_PER_M, Ground, look_at
from perception.vision.finding.plate import find_plate
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind, spread_of
from perception.vision.knowledge_files import load_knowledge, write_generated_kind
from perception.vision.projection import PlateProjection
from perception.vision.teaching.condense import worth_keeping

DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "vision" / "synth_dev"
FOLDS = 3
LEVELS = 3  # alternate in the folder, so folds of every third overview would hold out one level entirely
ELSEWHERE_PX = 7.0  # a place further than this from the centre of every object is not an object
STEP = 0.01  # looks are stored with two decimals
NO_SIZE_M = (0.01, 0.01)
SLIDER_M = (0.05, 0.05)  # horizontal and vertical sliders are one kind
BINS = 8
BAD_LIGHT = "hard"
COPIES = 3  # drawn in bad light, of every overview in good light
COPIES_OF_NOTHING = 2  # copies that also teach places without object; a third adds size but no recall
NOTHING_MARGIN = 0.015  # margin for looks in bad light; twice as many are of nothing as of objects


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Examples:
    """Examples in one image of an overview: objects with their centres and looks, and candidate places with looks."""

    truth: list[dict[str, Any]]
    places: Array
    looks: Array
    middles: Array
    object_looks: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lesson(Examples):
    """Examples of one overview with its rectified plate; `worse` are the examples that it would give in bad light."""

    level: str
    view: PlateProjection
    ground: Ground
    worse: tuple[Examples, ...]


def lessons(folder: Path) -> Iterator[Lesson]:
    """Yield the overviews of a folder in which the plate is found."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    for name, entry in truth.items():
        read = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) if entry["kind"] == "overview" else None
        if read is None or "lights_on" in entry or name.endswith("_off.png"):
            continue
        gray = np.asarray(read, np.uint8)
        plate = find_plate(gray, *PLATE_M)
        if plate is None:
            continue
        worse = (_worse(gray, plate.view, entry, copy) for copy in range(COPIES) if entry["level"] != BAD_LIGHT)
        ground = lay_out(gray, plate.view, PLATE_M)
        seen_there = _seen_there(ground, plate.view, entry["objects"])
        yield Lesson(level=entry["level"], view=plate.view, ground=ground, worse=tuple(worse), **seen_there)


def _seen_there(ground: Ground, view: PlateProjection, truth: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the fields of `Examples`."""
    pixels = np.array([[*panel_object["center_px"], 1.0] for panel_object in truth])
    on_plate = pixels @ np.linalg.inv(view.px_from_plate).T
    xy = on_plate[:, :2] / on_plate[:, 2:]
    middles = np.column_stack([xy[:, 0] + PLATE_M[0] / 2, PLATE_M[1] / 2 - xy[:, 1]]) * PLATE_PX_PER_M
    places = candidate_places(ground)
    looks, object_looks = look_at(ground, places), look_at(ground, middles)
    return {"truth": truth, "places": places, "looks": looks, "middles": middles, "object_looks": object_looks}


def _worse(gray: Image, view: PlateProjection, entry: dict[str, Any], copy: int) -> Examples:
    """Return the examples of the overview as it would look in bad light, with the visibility of its objects."""
    random = np.random.default_rng((copy, *gray.tobytes()[:: gray.size // 8]))  # different light per overview
    light = (gray.astype(float) / 255) ** GAMMA
    image, cover, bright = pictured(random, light, AMOUNTS[BAD_LIGHT], (gray.shape[1], gray.shape[0]))
    px_from_mm = np.array(entry["H_mm_to_px"])
    truth = [{**panel_object, **seen(panel_object, px_from_mm, cover, bright)} for panel_object in entry["objects"]]
    for worse, panel_object in zip(truth, entry["objects"], strict=True):
        worse["visible"] *= panel_object["visible"]
    return Examples(**_seen_there(lay_out(image, view, PLATE_M), view, truth))


def knowledge_of(taught: Sequence[Lesson]) -> Knowledge:
    """Return condensed looks of all kinds and of nothing, and looks in bad light that these do not recognise."""
    looks, names = _examples(taught)
    kinds = [
        TaughtKind(
            name=name, size_m=_size_m(taught, name), looks=looks[names == name], taught_by="benchmarks/vision_knowledge"
        )
        for name in sorted(set(names.tolist()))
    ]
    kept = worth_keeping(looks, names, spread_of(kinds))
    rounded = np.round(looks[kept] / STEP) * STEP
    short = tuple(replace(kind, looks=rounded[names[kept] == kind.name]) for kind in kinds)
    return with_noisy(Knowledge(kinds=short, spread=spread_of(short)), taught)


def with_noisy(known: Knowledge, taught: Sequence[Lesson]) -> Knowledge:
    """Return the knowledge extended by looks in bad light that it does not recognise yet."""
    worse = [
        each if k < COPIES_OF_NOTHING else replace(each, places=each.places[:0], looks=each.looks[:0])
        for lesson in taught
        for k, each in enumerate(lesson.worse)
    ]
    looks, names = _examples(worse)
    in_use = known.for_image(noisy=True)
    kept = worth_keeping(looks, names, known.spread, known=in_use, nothing_margin=NOTHING_MARGIN)
    rounded = np.round(looks[kept] / STEP) * STEP
    for name in sorted(set(names[kept].tolist())):
        of_kind = rounded[names[kept] == name]
        noisy = np.ones(len(of_kind), bool)
        known = known.grown(TaughtKind(name=name, size_m=NO_SIZE_M, looks=of_kind, noisy=noisy))
    return known


def _examples(taught: Sequence[Examples]) -> tuple[Array, NDArray[np.str_]]:
    """Return (N, LENGTH) looks and (N,) kinds of all objects that are at least half visible, and of other places."""
    looks, names = [], []
    for lesson in taught:
        for panel_object, look in zip(lesson.truth, lesson.object_looks, strict=True):
            if panel_object["visible"] >= 0.5:
                looks.append(look)
                names.append(str(panel_object["cls"]))
        away = np.linalg.norm(lesson.places[:, None] - lesson.middles[None], axis=2).min(axis=1) > ELSEWHERE_PX
        looks += list(lesson.looks[away])
        names += [NOTHING] * int(away.sum())
    return np.array(looks), np.array(names)


def _size_m(taught: Sequence[Lesson], name: str) -> tuple[float, float]:
    sizes = [panel_object["size"] for lesson in taught for panel_object in lesson.truth if panel_object["cls"] == name]
    if name == "slider":
        return SLIDER_M
    width, height = np.median(np.array(sizes), axis=0) / 1000 if sizes else NO_SIZE_M
    return float(width), float(height)


def judged(lesson: Lesson, knowledge: Knowledge) -> tuple[list[tuple[float, bool]], int]:
    """Return (confidence, right) of every accepted candidate, and how many objects are at least half visible."""
    found = chosen(lesson.ground, lesson.places, lesson.looks, knowledge, lesson.view, PLATE_M)
    rows = [(c.confidence, right) for c in found if c.reason is None and (right := _right(lesson, c)) is not None]
    return rows, sum(panel_object["visible"] >= 0.5 for panel_object in lesson.truth)


def _right(lesson: Lesson, candidate: Detection) -> bool | None:
    """Return whether the nearest object is of that kind and near enough; None if most of it is hidden."""
    off = [float(np.linalg.norm(candidate.centre_px - panel_object["center_px"])) for panel_object in lesson.truth]
    panel_object = lesson.truth[int(np.argmin(off))]
    near = min(off) < 0.5 * max(panel_object["bbox_px"][2:])
    return None if near and panel_object["visible"] < 0.5 else bool(near and panel_object["cls"] == candidate.kind)


def _print_folds(all_lessons: Sequence[Lesson]) -> None:
    rows: dict[str, list[tuple[float, bool]]] = {}
    there: dict[str, int] = {}
    for fold in range(FOLDS):
        knowledge = knowledge_of([lesson for k, lesson in enumerate(all_lessons) if k // LEVELS % FOLDS != fold])
        for lesson in (x for k, x in enumerate(all_lessons) if k // LEVELS % FOLDS == fold):
            found, count = judged(lesson, knowledge)
            rows.setdefault(lesson.level, []).extend(found)
            there[lesson.level] = there.get(lesson.level, 0) + count
    for level, found in rows.items():
        right = sum(ok for _, ok in found)
        print(f"held out, {level:8s} recall {right / there[level]:.3f}  precision {right / len(found):.3f}")
    pairs = np.array(sorted(pair for found in rows.values() for pair in found), float)
    error = 0.0
    print("reliability: mean confidence, share right, candidates")
    for part in np.array_split(pairs, BINS):
        error += len(part) / len(pairs) * abs(float(part[:, 0].mean() - part[:, 1].mean()))
        print(f"  {part[:, 0].mean():.3f} {part[:, 1].mean():.3f} {len(part)}")
    print(f"expected calibration error {error:.3f}")


def main() -> int:
    """Print the results of held-out overviews, and write what all overviews teach."""
    only_noisy = sys.argv[2:] == ["--only-noisy"]
    if len(sys.argv) != 2 + only_noisy or not DATA.exists():
        print(__doc__ if DATA.exists() else "no labelled overviews beside the repository")
        return 2
    cv2.setNumThreads(1)
    everything = list(lessons(DATA))
    _print_folds(everything)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    shipped = load_knowledge().for_image(noisy=False)
    for kind in (with_noisy(shipped, everything) if only_noisy else knowledge_of(everything)).kinds:
        write_generated_kind(kind, folder)
        print(f"{kind.name}: {len(kind.looks)} looks")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
