"""Taught readings of the development images in good light, degraded again as in bad light, with many seeds.

`python -m benchmarks.vision_redegraded [FIRST [COUNT [LEVEL]]]`: every easy overview and close-up of 640x480 is warped
to the view of a tilted camera and degraded by the light, cables, blur and noise of a level (`panel_scene.pictured`;
shapes, order and amounts are those of the hard development images). The files contain 18 hard displays, and every seed
adds as many. The figures of the level's own images are printed for comparison. Seeds 0 to 11 and 100 to 115 were used
in development.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.panel_scene import AMOUNTS, FOCAL_PX, GAMMA, LEVELS, Level, Scene, pictured, seen
from benchmarks.vision import DATA
from benchmarks.vision_held_out import SURE, Judged, read_scene
from benchmarks.vision_report import module_of
from hal.arrays import Array
from perception.vision.image import as_gray, decode

FIRST, COUNT, LEVEL = 1000, 3, "hard"
OWN_BLUR_PX = 0.36  # blur of an easy image; the new blur adds to it in quadrature
SHOWN = ("gauge", "panel_meter", "display", "toggle", "rotary", "button", "lamp", "lever", "slider", "handwheel")


def development_truth() -> dict[str, Any]:
    """Return the truth of the development overviews and close-ups, by file name."""
    truth = json.loads((DATA / "synth_dev" / "truth.json").read_text(encoding="utf-8"))
    return {name: t for name, t in truth.items() if t["kind"] in ("overview", "close") and "lights_on" not in t}


def development_scene(name: str, truth: dict[str, Any]) -> Scene:
    """Return a development image without changes."""
    return Scene(image=decode((DATA / "synth_dev" / name).read_bytes()), truth=truth, taught=_taught_job(name, truth))


def redegraded(name: str, truth: dict[str, Any], seed: int, level: str) -> Scene:
    """Return a development image in good light as another camera would see it in the light of a level."""
    random = np.random.default_rng((seed, LEVELS.index(level), *name.encode()))
    image = as_gray(decode((DATA / "synth_dev" / name).read_bytes()))
    height, width = image.shape
    amount = _sharper(AMOUNTS[level])
    old_from_mm = np.array(truth["H_mm_to_px"])
    new_from_mm = _placed(random, old_from_mm, (width, height), truth["px_per_mm"], amount.tilt_rad)
    k = 2  # drawn at twice the final resolution; pixel centres are at half-integers
    grow = np.array([[k, 0, (k - 1) / 2], [0, k, (k - 1) / 2], [0, 0, 1.0]])
    new_from_old = grow @ new_from_mm @ np.linalg.inv(old_from_mm)
    light = (np.asarray(image, np.float32) / 255) ** GAMMA
    size = (k * width, k * height)
    drawn = cv2.warpPerspective(light, new_from_old, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    known = cv2.warpPerspective(np.ones_like(light), new_from_old, size)
    picture, cover, bright = pictured(random, np.asarray(np.maximum(drawn, 0), float), amount, (width, height))
    hidden = np.maximum(
        cover, 1.0 - np.asarray(cv2.resize(known, (width, height), interpolation=cv2.INTER_AREA), float)
    )
    objects = []
    for panel_object in truth["objects"]:
        now = seen(panel_object, new_from_mm, hidden, bright)
        objects.append({**panel_object, **now, "readable": now["readable"] and panel_object["readable"]})
    taken = {**truth, "level": level, "H_mm_to_px": new_from_mm.tolist(), "objects": objects}
    return Scene(image=picture, truth=taken, taught=_taught_job(f"{seed}_{name}", taken))


def _sharper(amount: Level) -> Level:
    """Return the amounts with the blur reduced by that of an easy image."""
    least, most = (float(np.sqrt(max(b**2 - OWN_BLUR_PX**2, 0.01))) for b in amount.blur_px)
    return replace(amount, blur_px=(least, most))


def _placed(
    random: np.random.Generator, old_from_mm: Array, size_px: tuple[int, int], px_per_mm: float, most_rad: float
) -> Array:
    """Return the (3, 3) homography from panel millimetres to pixels of a tilted camera with the old view centre."""
    middle_px = np.array([size_px[0] / 2, size_px[1] / 2, 1.0])
    x, y, w = np.linalg.solve(old_from_mm, middle_px)
    lean, tilt = random.uniform(0, 2 * np.pi), most_rad * np.sqrt(random.uniform(0.1, 1.0))
    axis = np.array([np.cos(lean), np.sin(lean), 0.0])
    turn = Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0, 0, random.normal(0, 0.35 * most_rad)])
    R = turn.as_matrix()
    far = FOCAL_PX / px_per_mm
    t = far * np.array([*random.normal(0, 0.015, 2), random.uniform(0.97, 1.05)]) - R @ np.array([x / w, y / w, 0.0])
    K = np.array([[FOCAL_PX, 0, size_px[0] / 2], [0, FOCAL_PX, size_px[1] / 2], [0, 0, 1]])
    return np.asarray(K @ np.column_stack([R[:, :2], t]))


def _taught_job(name: str, truth: dict[str, Any]) -> dict[str, Any]:
    """Return the job that the script of the data makes for an image."""
    jobs = module_of(DATA / "make_inputs.py").jobs({name: truth})
    return next(job for job in jobs if job["mode"] == "taught")


def scenes(first: int, count: int, level: str) -> Iterator[Scene]:
    """Yield every easy 640x480 image in the light of a level, `count` times."""
    easy = {n: t for n, t in development_truth().items() if t["level"] == "easy" and t["width"] == 640}
    for seed in range(first, first + count):
        for name, truth in easy.items():
            yield redegraded(name, truth, seed, level)


def table(rows: list[Judged]) -> list[str]:
    """Return a line per kind: count, right, refused, wrong, wrong at 0.8 or more; then all, and 5 % more refused."""
    lines = [f"  {'':12s} {'n':>5s} {'right':>6s} {'refused':>8s} {'wrong':>6s} {'sure and wrong':>15s}"]
    for kind in (*SHOWN, "all"):
        of_kind = [row for row in rows if kind in (row.kind, "all")]
        if not of_kind:
            continue
        right, wrong = [r for r in of_kind if r.is_right], [r for r in of_kind if r.answered and not r.is_right]
        refused, sure = len(of_kind) - len(right) - len(wrong), sum(r.confidence >= SURE for r in wrong)
        shares = [len(right), refused, len(wrong)] / np.array(len(of_kind))
        lines.append("  {:12s} {:5d} {:6.3f} {:8.3f} {:6.3f} {:15d}".format(kind, len(of_kind), *shares, sure))
    given = sorted((r for r in rows if r.answered), key=lambda r: r.confidence)
    kept = given[round(0.05 * len(given)) :]
    return [
        *lines,
        f"  wrong among answers when the 5 % least sure are refused: {np.mean([not r.is_right for r in kept]):.4f}",
    ]


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    cv2.setNumThreads(1)
    first, count = int(arguments[0]) if arguments else FIRST, int(arguments[1]) if len(arguments) > 1 else COUNT
    level = arguments[2] if len(arguments) > 2 else LEVEL
    own = [development_scene(n, t) for n, t in development_truth().items() if t["level"] == level]
    print(f"{level} development images as they are", *table([r for s in own for r in read_scene(s)]), sep="\n")
    rows: list[Judged] = []
    for k, scene in enumerate(scenes(first, count, level), 1):
        rows += read_scene(scene)
        print(f"\r{k} images", end="", file=sys.stderr, flush=True)
    print(
        f"\neasy development images taken again, {level}, seeds {first} to {first + count - 1}", *table(rows), sep="\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
