"""Range benchmark: predictions for given cases, or the whole table of goals on development scenes.

python -m benchmarks.range CASES_DIR OUT_DIR [--time] [--codes]   predictions in the scorer's format, mm
python -m benchmarks.range [--seeds N]                            the table: pass line beside measured value
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks import range_matching, range_peers, range_rooms
from benchmarks.range_filter_pass import filter_pass
from benchmarks.range_sensors import SENSORS, table_top
from benchmarks.range_soft import SCENES, VIEWS, soft_scene
from hal.arrays import Array
from perception.range import Surface, analyse
from perception.range.primitives import Cone, Cylinder, Ellipsoid, Plane, Sphere
from perception.range.recordings import Reading, load_recording, sensor_from_meta
from perception.range.warm import warm_up
from perception.range.window import Window

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "range"
MM = 1000.0
MATCHED_SEEDS = 5  # with fourteen components per scene
PEER_SEEDS = 2  # a peer takes seconds per image


def main() -> None:
    """Run the command line; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="?", type=Path)
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--time", action="store_true", help="store the median of three runs as `ms`")
    parser.add_argument("--codes", action="store_true", help="read the 8-bit codes instead of the depth")
    parser.add_argument("--seeds", type=int, default=20, help="seeds a line of the table")
    arguments = parser.parse_args()
    warm_up()
    if arguments.cases is None:
        print_table(arguments.seeds)
        return
    if arguments.out is None:
        parser.error("OUT_DIR is missing")
    predict(arguments.cases, arguments.out, timed=arguments.time, codes=arguments.codes)


def predict(cases: Path, out: Path, *, timed: bool, codes: bool) -> None:
    """Write one prediction per case into `out`; for an unreadable case an empty one and a line on stderr."""
    out.mkdir(parents=True, exist_ok=True)
    for path in sorted(cases.glob("*.npz")):
        depth, sensor = load_recording(path, reading=Reading(codes=codes))
        try:
            scene = analyse(depth, sensor)
            labels, surfaces = scene.labels, scene.surfaces
        except Exception as error:
            print(f"{path.name}: {error}", file=sys.stderr)
            labels, surfaces = np.zeros(depth.shape, np.int32), ()
        arrays = {"labels": labels, "prims": np.array(json.dumps([prediction(s) for s in surfaces]))}
        if timed and surfaces:
            arrays["ms"] = np.array(_median_ms(partial(analyse, depth, sensor), 3))
        _save(out / path.name, arrays)


def _save(path: Path, arrays: dict[str, Any]) -> None:
    np.savez_compressed(path, **arrays)


def prediction(surface: Surface) -> dict[str, Any]:
    """Return a surface in the scorer's format, in millimetres."""
    p = surface.primitive
    out: dict[str, Any] = {"id": surface.label, "type": str(surface.type), "rms": surface.rms_m * MM}
    if isinstance(p, Plane):
        return out | {"n": p.normal.tolist(), "c": (p.point_m * MM).tolist()}
    if isinstance(p, Sphere):
        return out | {"c": (p.centre_m * MM).tolist(), "r": p.radius_m * MM}
    if isinstance(p, Cylinder):
        return out | {"c": (p.point_m * MM).tolist(), "axis": p.axis.tolist(), "r": p.radius_m * MM}
    if isinstance(p, Cone):
        return out | {"apex": (p.apex_m * MM).tolist(), "axis": p.axis.tolist(), "half_angle": p.half_angle_rad}
    assert isinstance(p, Ellipsoid)
    return out | {"c": (p.centre_m * MM).tolist(), "radii": (p.radii_m * MM).tolist()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """Line of the table: name, pass line as text, measured value as text, and whether it passes."""

    name: str
    needed: str
    measured: str
    passed: bool


def print_table(seeds: int) -> None:
    """Measure every line on development scenes and print the pass lines beside the measured values."""
    if not (DATA / "gen.py").exists():
        print("the range development data is not beside this repository: nothing to measure", file=sys.stderr)
        return
    gen, score = range_module("gen"), range_module("score")
    lines = [*_quality_lines(gen, score, seeds), *_code_lines(gen, score, seeds), *_real_lines(score)]
    lines += _sensor_lines(gen, score, seeds)
    lines += _matching_lines(gen, min(seeds, MATCHED_SEEDS))
    lines += _time_lines(gen)
    lines += _peer_lines(gen, score)
    width = max(len(line.name) for line in lines)
    print(f"{'line':<{width}}  {'pass':<22} {'measured':<34} result")
    for line in lines:
        result = "" if line.needed == "-" else "pass" if line.passed else "FAIL"
        print(f"{line.name:<{width}}  {line.needed:<22} {line.measured:<34} {result}")


def range_module(name: str) -> ModuleType:
    """Return a program of the range development data (`gen` or `score`) as a module."""
    spec = importlib.util.spec_from_file_location(f"range_{name}", DATA / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _cases(gen: ModuleType, scene: str, seeds: int, **kind: Any) -> list[dict[str, Any]]:
    return drawn_cases(gen, scene, 100, seeds, **kind)


def drawn_cases(gen: ModuleType, scene: str, first: int, seeds: int, **kind: Any) -> list[dict[str, Any]]:
    """Return cases of one scene of the generator, of the seeds from `first` on."""
    cases = []
    for seed in range(first, first + seeds):
        case = gen.make(scene, seed, **kind)
        case["meta"] = json.loads(json.dumps(case["meta"], default=lambda o: o.tolist()))
        cases.append(case)
    return cases


def case_depth(case: dict[str, Any], codes: bool) -> Array:
    if codes:
        u8 = case["meta"]["u8"]
        return Window(near_m=u8["near"] / MM, far_m=u8["far"] / MM).decode(case["u8"])
    return np.asarray(case["depth"], float) / MM


def _scored(
    score: ModuleType, cases: list[dict[str, Any]], *, codes: bool = False, bound: Any = None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    rows = []
    for case in cases:
        scene = analyse(case_depth(case, codes), sensor_from_meta(case["meta"]["sensor"], 1 / MM))
        rows.append(score.score_case(case, scene.labels, [prediction(s) for s in scene.surfaces], 0.8, bound))
    return score.summarise(rows), rows


def _rate(name: str, needed: float, hits: int, total: int) -> Line:
    rate = hits / max(total, 1)
    measured = f"{100 * rate:.1f} % of {total}"
    return Line(name=name, needed=f">= {100 * needed:.0f} %", measured=measured, passed=rate >= needed)


def _correct(name: str, needed: float, summary: dict[str, Any], tolerance: str = "0.8") -> Line:
    h = summary["hoover"][tolerance]
    return _rate(name, needed, h["correct"], h["gt"])


def _quality_lines(gen: ModuleType, score: ModuleType, seeds: int) -> list[Line]:
    poly, poly_rows = _scored(score, _cases(gen, "polyhedra", seeds), bound=gen.crlb)
    _, fig10_rows = _scored(score, _cases(gen, "fig10", seeds), bound=gen.crlb)
    oblique, oblique_rows = _scored(score, _cases(gen, "fig10_oblique", seeds), bound=gen.crlb)
    curved, curved_rows = _scored(score, _cases(gen, "curved", seeds), bound=gen.crlb)
    panel, _ = _scored(score, _cases(gen, "panel", seeds))
    small, _ = _scored(score, _cases(gen, "panel", seeds, n=128))
    rows = [*poly_rows, *fig10_rows, *oblique_rows, *curved_rows]
    whole = sum(_all_six(r) for r in fig10_rows)
    cones = [sum(r["correct_by_type"]["cone"][k] for r in curved_rows) for k in (0, 1)]
    named = [a == b for r in rows for a, b in r["types"]]
    ratio = statistics.median(_bound_ratios(rows))
    return [
        _correct("polyhedra", 0.90, poly),
        _rate("fig10: all six found and named", 0.90, whole, len(fig10_rows)),
        _correct("fig10 oblique", 0.90, oblique),
        _correct("curved", 0.85, curved),
        _rate("curved: cones", 0.75, cones[0], cones[1]),
        _rate("labels of correct regions", 0.98, sum(named), len(named)),
        _correct("panel 256", 0.75, panel),
        _correct("panel 128", 0.55, small),
        Line(
            name="parameter error / noise bound", needed="median <= 1.6", measured=f"{ratio:.2f}", passed=ratio <= 1.6
        ),
    ]


def _all_six(row: dict[str, Any]) -> bool:
    """Return whether all six surfaces of fig10 are found with the right type, and nothing else."""
    h = row["hoover"]["0.8"]
    return bool(h["correct"] == h["ms"] == 6 and all(a == b for a, b in row["types"]))


def _bound_ratios(rows: list[dict[str, Any]]) -> list[float]:
    out = []
    for error in (e for r in rows for e in r["errors"]):
        for key, deviation in (error.get("bound") or {}).items():
            if key in error and deviation > 0:
                value = np.radians(error[key]) if "angle" in key else error[key]
                out.append(float(value / deviation))
    return out


def _code_lines(gen: ModuleType, score: ModuleType, seeds: int) -> list[Line]:
    out = []
    for share, needed in ((0.5, 0.90), (0.25, 0.75), (0.1, 0.40)):
        summary, _ = _scored(score, _cases(gen, "fig10", seeds, use=share, sigma=0.25), codes=True)
        out.append(_correct(f"8-bit fig10, share {share}", needed, summary))
    return out


def _real_lines(score: ModuleType) -> list[Line]:
    """Return the line of the only real frame with known truth."""
    path = DATA / "real" / "icl_living_room_0.npz"
    if not path.exists():
        return []
    with np.load(path) as data:
        case = {k: data[k] for k in data.files}
    case["meta"] = json.loads(str(case["meta"]))
    summary, _ = _scored(score, [case])
    return [
        _correct("real: living room, T 0.8", 0.70, summary),
        _correct("real: living room, T 0.9", 0.50, summary, "0.9"),
    ]


def _matching_lines(gen: ModuleType, seeds: int) -> list[Line]:
    tally = range_matching.run(gen, range(100, 100 + seeds), is_occluded=True)
    there, found = sum(tally.there.values()), sum(tally.found.values())
    place_mm, angle_deg = (float(np.median(e)) for e in (np.multiply(tally.place_m, MM), np.degrees(tally.angle_rad)))
    return [
        _rate("models, 40 % hidden: recall", 0.90, found, there),
        _rate("models, 40 % hidden: precision", 0.95, found, found + len(tally.wrong)),
        Line(
            name="models, 40 % hidden: pose, median",
            needed="<= 1 mm, 0.5 deg",
            measured=f"{place_mm:.2f} mm, {angle_deg:.2f} deg",
            passed=place_mm <= 1.0 and angle_deg <= 0.5,
        ),
    ]


def _sensor_lines(gen: ModuleType, score: ModuleType, seeds: int) -> list[Line]:
    """Return the lines of simulated table tops seen by structured light, stereo and time-of-flight sensors."""
    numbers = range(100, 100 + max(1, seeds // 4))
    summary, _ = _scored(score, [table_top(gen, sensor, seed) for sensor in SENSORS for seed in numbers])
    return [
        _correct("simulated depth sensors, T 0.8", 0.70, summary),
        _correct("simulated depth sensors, T 0.9", 0.50, summary, "0.9"),
        *_soft_lines(gen, score, numbers[: max(1, seeds // 10)]),
        *_room_lines(gen, score, numbers),
    ]


def _soft_lines(gen: ModuleType, score: ModuleType, numbers: range) -> list[Line]:
    """Return the lines of cartons with bulging faces and rounded edges on a table, and of a room with a sofa."""
    out = []
    for scene in SCENES:
        summary, _ = _scored(score, [soft_scene(gen, scene, sensor, seed) for sensor in VIEWS for seed in numbers])
        out += [
            _correct(f"bulged and rounded, {scene}, T 0.8", 0.70, summary),
            _correct(f"bulged and rounded, {scene}, T 0.9", 0.50, summary, "0.9"),
        ]
    return out


def _room_lines(gen: ModuleType, score: ModuleType, numbers: range) -> list[Line]:
    """Return the lines of furnished rooms seen by every sensor; they have no pass lines."""
    out = []
    for view in range_rooms.VIEWS:
        hoover = _scored(score, [range_rooms.room(gen, view, seed) for seed in numbers])[0]["hoover"]
        rates = [100 * hoover[tolerance]["correct"] / max(hoover[tolerance]["gt"], 1) for tolerance in ("0.8", "0.9")]
        measured = f"{rates[0]:.1f}; {rates[1]:.1f} % of {hoover['0.8']['gt']}"
        out.append(Line(name=f"rooms, {view}, T 0.8; 0.9", needed="-", measured=measured, passed=True))
    return out


def _time_lines(gen: ModuleType) -> list[Line]:
    out = []
    for name, limit_ms, kind in (
        ("256x256", 10.0, {"n": 256}),
        ("640x480", 40.0, {"n": 480, "aspect": 4 / 3}),
    ):
        whole, ratios = [], []
        for scene in ("polyhedra", "curved", "panel", "fig10"):
            case = _cases(gen, scene, 1, **kind)[0]
            depth, sensor = case_depth(case, False), sensor_from_meta(case["meta"]["sensor"], 1 / MM)
            analyse(depth, sensor)
            # CPU time of one thread, so that other programs on the machine do not count.
            ms = _median_ms(partial(analyse, depth, sensor), 7, clock=time.process_time)
            whole.append(ms)
            ratios.append(ms / _median_ms(filter_pass(depth, sensor), 15, clock=time.process_time))
        ms, ratio = statistics.median(whole), statistics.median(ratios)
        spread = f"{ms:.1f} ms ({min(whole):.0f} to {max(whole):.0f})"
        needed = f"<= {limit_ms:.0f} ms"
        out.append(Line(name=f"chain, {name}, one thread", needed=needed, measured=spread, passed=ms <= limit_ms))
        out.append(
            Line(name=f"chain / filter pass, {name}", needed="<= 40", measured=f"{ratio:.1f}", passed=ratio <= 40)
        )
    return out


def _median_ms(work: Callable[[], object], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(1e3 * (clock() - start))
    return statistics.median(times)


def _peer_lines(gen: ModuleType, score: ModuleType) -> list[Line]:
    """Return correct regions and times of third-party segmenters, if installed, and of ours on the same images."""
    cases = [case for scene in ("polyhedra", "fig10", "curved") for case in _cases(gen, scene, PEER_SEEDS)]
    seen = [(case_depth(case, False), sensor_from_meta(case["meta"]["sensor"], 1 / MM)) for case in cases]
    peers = range_peers.peer_results(score, [(c, MM * s.points(d)) for c, (d, s) in zip(cases, seen, strict=True)])
    if not peers:
        print("no peers: `pip install -e '.[bench]'` brings Open3D and pyransac3d", file=sys.stderr)
        return []
    ours = _scored(score, cases)[0]["hoover"]["0.8"]
    ms = statistics.median(_median_ms(partial(analyse, *image), 1) for image in seen)
    rows = [(f"peer: {p.name}", p.correct, p.regions, p.ms) for p in peers]
    return [
        Line(name=name, needed="-", measured=f"{100 * good / max(n, 1):.1f} % of {n}, {took:.0f} ms", passed=True)
        for name, good, n, took in [*rows, ("the same images, ours", ours["correct"], ours["gt"], ms)]
    ]


if __name__ == "__main__":
    main()
