"""Measures nine-class fusion: errors against their bound, mismatches, brute force, times, and other methods.

python -m benchmarks.fusion CASES.json OUT.json [--time]    solve a file of cases (schema of data/fusion)
python -m benchmarks.fusion [--quick] [--no-pose]           print the table, pass line beside measured value

Rows of the four-light pose (with cv2, poselib, gtsam) come last; `python -m benchmarks.pose` prints them with more
problems.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.fusion_peers import Row, peers
from benchmarks.fusion_problems import Tally, codes, mismatched, mixed, random_measurement, rotation
from benchmarks.fusion_reference import brute_force
from benchmarks.fusion_simulation import TABLE_II, problem
from benchmarks.pose import table as pose_table
from fusion import Measurement, SensingClass, fuse, warm_up
from fusion.certify import certificate
from fusion.distance import local_value, local_values
from fusion.errors import Contradiction
from fusion.robust import used_entries
from fusion.solve import solve
from hal.arrays import Array
from hal.geometry import difference, matrix_of, perturbed, transform

ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])  # the case files put rotation first, the product translation


# --- case files ------------------------------------------------------------------------------------------------------


def measurement_of(value: dict[str, Any]) -> Measurement:
    """Return a measurement of a case file, without `outlier` and anything else that a solver must not know."""
    return Measurement(
        cls=SensingClass.named(value["cls"]),
        x_m=np.array(value["x"], float),
        u=np.array(value["u"], float),
        mu_m=np.array(value["mu"], float),
        C_m2=_symmetric(value["C"]),
        M=_symmetric(value["M"]),
        label=value["code"],
        sensor=value["sensor"],
    )


def _symmetric(upper: Sequence[float]) -> Array:
    out = np.zeros((3, 3))
    out[np.triu_indices(3)] = upper
    return out + out.T - np.diag(np.diag(out))


def solution(case: dict[str, Any], *, timed: bool) -> dict[str, Any] | None:
    """Return the solution of one case in the scorer's schema (rotation first), or None if fusion refuses."""
    measurements = [measurement_of(m) for m in case["measurements"]]
    started_s = time.process_time()
    try:
        answer = fuse(measurements)
    except Contradiction:
        return None
    ms = (time.process_time() - started_s) * 1e3
    made: dict[str, Any] = {
        "R": matrix_of(answer.pose).tolist(),
        "t": answer.pose.translation.tolist(),
        "cov": answer.covariance[np.ix_(ROTATION_FIRST, ROTATION_FIRST)].ravel().tolist(),
        "outliers": mismatched(answer),
        "alternatives": [
            {"R": matrix_of(a.pose).tolist(), "t": a.pose.translation.tolist(), "odds": a.odds}
            for a in answer.alternatives
        ],
        "unobservable": [free.words for free in answer.unobservable],
    }
    # Exactness is judged at the true pose, which the case file contains for this purpose only.
    if "R_true" in case:
        made["f"] = local_values(measurements, transform(case["R_true"], case["t_true"])).tolist()
    return made | {"ms": ms} if timed else made


def solve_file(cases_file: Path, out_file: Path, *, timed: bool) -> None:
    """Write the solutions of a case file; refused cases are left out."""
    warm_up()
    cases = json.loads(cases_file.read_text())["cases"]
    answers = {case["id"]: solution(case, timed=timed) for case in cases}
    out_file.write_text(json.dumps({k: v for k, v in answers.items() if v is not None}))
    refused = [k for k, v in answers.items() if v is None]
    print(f"{len(answers) - len(refused)} solved, {len(refused)} refused{': ' if refused else ''}{', '.join(refused)}")


# --- figures -----------------------------------------------------------------------------------------------------------


def exactness(per_class: int, rng: np.random.Generator) -> Iterator[Row]:
    """Yield the largest relative difference from brute force for random SPD C and PSD M, over all nine classes."""
    kinds = {"plain": "condition up to 1e3", "wide": "condition up to 1e6", "flat": "rank-one M"}
    for kind, words in kinds.items():
        worst = 0.0
        for cls in SensingClass:
            for _ in range(per_class):
                m, pose = random_measurement(cls, rng, kind=kind), transform(rotation(rng), rng.normal(0, 0.3, 3))
                f = brute_force(m, pose)
                worst = max(worst, (local_value(m, pose) - f) / (1e-3 + f))  # negative: brute force was less accurate
        yield f"nine local pose functions above brute force, {words}", "<= 1e-6", f"{worst:.1e}"


def consistency(problems: int, rng: np.random.Generator) -> list[Row]:
    """Measure efficiency and consistency without mismatches: N = 16, N = 10, and N = 12 with condition number 100."""
    rows: list[Row] = []
    for name, count, anisotropy in (("N=16", 16, 1.0), ("N=10", 10, 1.0), ("N=12, cond(C) = 100", 12, 100.0)):
        t = mixed(count, 0, problems, rng, anisotropy=anisotropy)
        inside = np.mean(np.array(t.nees) < chi2.ppf(0.95, 6))
        rows += [
            (f"RMS / bound, position and rotation, {name}", "<= 1.05",
             f"{np.sqrt(np.mean(t.position)):.3f} {np.sqrt(np.mean(t.rotation)):.3f}"),
            (f"NEES / 6, {name} ({len(t.nees)} problems)", "0.93-1.07",
             f"{np.mean(t.nees) / 6:.3f} (+-{np.sqrt(12 / len(t.nees)) / 6:.3f}), {inside:.1%} in the 95 % ellipsoid"),
        ]  # fmt: skip
    return rows


def mismatches(problems: int, rng: np.random.Generator) -> list[Row]:
    """Measure success, recall and false rejection with mismatched measurements, and the results of all-bad sets."""
    limits = {(16, 1): "100 %", (16, 4): "99 %", (16, 8): "97 %", (24, 12): "99 %", (40, 28): "85 %"}
    rows: list[Row] = []
    half = Tally()
    for (count, bad), limit in limits.items():
        t = mixed(count, bad, problems, rng)
        rows.append((f"N={count} with {bad} bad: success", f">= {limit}",
                     f"{t.near / t.count:.1%} ({t.count}, {t.refused} refused, median {np.median(t.ms):.0f} ms)"))  # fmt: skip
        if 2 * bad <= count:
            for name in ("bad", "named", "good", "dropped"):
                setattr(half, name, getattr(half, name) + getattr(t, name))
    rows += [
        ("recall of bad ones, up to 50 % bad", ">= 99 %", f"{half.named / half.bad:.2%} of {half.bad}"),
        ("good ones rejected, up to 50 % bad", "<= 1 %", f"{half.dropped / half.good:.2%} of {half.good}"),
    ]
    hopeless = mixed(16, 16, problems // 2, rng)
    rows.append(("N=16 with 16 bad: refused, not answered", "-", f"{hopeless.refused / hopeless.count:.0%}"))
    return rows


def table_ii(runs: int, rng: np.random.Generator) -> list[Row]:
    """Solve the paper's sequence with its first measurement mismatched."""
    last, named_from = [], []
    for _ in range(runs):
        made = problem(TABLE_II, rng, bad=[0])
        named = []
        for n in range(5, 17):
            try:
                answer = fuse(made.measurements[:n])
            except Contradiction:
                named.append(False)
                continue
            named.append(mismatched(answer) == [0])
            if n == 16:
                last.append(difference(made.base_from_object, answer.pose))
        named_from.append(5 + (12 - int(np.cumprod(named[::-1]).sum())))
    errors = np.array(last)
    mm, degrees = 1e3 * np.linalg.norm(errors[:, :3], axis=1), np.degrees(np.linalg.norm(errors[:, 3:], axis=1))
    return [
        ("Table II after 16: median position, rotation", "<= 0.45 mm, 0.07 deg",
         f"{np.median(mm):.2f} mm, {np.median(degrees):.3f} deg (worst {mm.max():.2f}, {degrees.max():.2f}; {runs} runs)"),
        ("Table II: bad one, and it alone, named from n =", "<= 5",
         f"{np.median(named_from):.0f} (in {np.mean(np.array(named_from) <= 5):.0%} of runs)"),
    ]  # fmt: skip


def certificates(problems: int, rng: np.random.Generator) -> list[Row]:
    """Measure how often the relaxation of a problem without mismatches yields a pose, and its time."""
    tight, ms = 0, []
    for _ in range(problems):
        made = problem(codes(rng, 16), rng)
        answer = fuse(made.measurements)
        b, used, local = used_entries(made.measurements, answer)
        started_s = time.process_time()
        tight += certificate(b, used, local).tight
        ms.append((time.process_time() - started_s) * 1e3)
    return [
        ("certificate tight without mismatches", ">= 99 %", f"{tight / problems:.1%} of {problems}"),
        ("certificate, time", "<= 8 ms", f"{np.median(ms):.2f} ms (best {np.min(ms):.2f})"),
    ]


def clock(rng: np.random.Generator) -> list[Row]:
    """Measure median times over problems with N = 16, from measurement objects to the answer."""
    made = [problem(codes(rng, 16), rng) for _ in range(100)]
    starts = [perturbed(p.base_from_object, rng.normal(0, 0.02, 6)) for p in made]
    local = _times_ms(lambda k: solve(made[k].measurements, starts[k]), 100)
    robust = _times_ms(lambda k: fuse(made[k].measurements), 100)
    quarter = [problem(codes(rng, 16), rng, bad=4) for _ in range(50)]
    worse = _times_ms(lambda k: fuse(quarter[k].measurements), 50)
    return [
        ("local solve with covariance, N=16", "<= 1 ms", f"{np.median(local):.3f} ms (best {np.min(local):.3f})"),
        ("robust, N=16, none bad", "<= 50 ms", f"{np.median(robust):.1f} ms (best {np.min(robust):.1f})"),
        ("robust, N=16, 4 bad", "<= 50 ms", f"{np.median(worse):.1f} ms (best {np.min(worse):.1f})"),
    ]


def _times_ms(run: Callable[[int], object], count: int) -> list[float]:
    times = []
    for k in range(count):
        started_s = time.process_time()
        run(k)
        times.append((time.process_time() - started_s) * 1e3)
    return times


def large_and_proven(rng: np.random.Generator, problems: int) -> Iterator[Row]:
    """Measure ten thousand measurements, and branch and bound over which of 16 measurements are inliers."""
    many = problem(codes(rng, 10_000), rng, bad=1000)
    answer, s = _timed_s(partial(fuse, many.measurements))
    delta = difference(many.base_from_object, answer.pose)
    yield "10 000 measurements, 1000 bad", "-", f"{s:.2f} s, {1e3 * np.linalg.norm(delta[:3]):.3f} mm off"
    for bad in (0, 4, 8):
        times, proven, agrees = [], 0, 0
        for _ in range(problems):
            made = problem(codes(rng, 16), rng, bad=bad)
            answer, s = _timed_s(partial(fuse, made.measurements, prove_set_within_s=60.0))
            found = answer.proven_set
            times.append(s)
            proven, agrees = proven + found.proven, agrees + found.agrees
        yield (f"best set proven by branch and bound, N=16, {bad} bad", "-",
               f"{proven} of {problems}, the answer's in {agrees}; median {np.median(times):.1f} s")  # fmt: skip


def _timed_s(run: Callable[[], Any]) -> tuple[Any, float]:
    started_s = time.process_time()
    return run(), time.process_time() - started_s


def table(*, quick: bool) -> Iterator[Row]:
    """Yield rows of (what, pass line, measured); times are CPU times."""
    rng = np.random.default_rng(20)
    warm_up()
    yield from exactness(1 if quick else 2, rng)
    yield from consistency(60 if quick else 400, rng)
    yield from mismatches(30 if quick else 300, rng)
    yield from table_ii(20 if quick else 60, rng)
    yield from certificates(30 if quick else 200, rng)
    yield from clock(rng)
    yield from large_and_proven(rng, 1 if quick else 3)
    yield from peers(10 if quick else 25, rng)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="?")
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--time", action="store_true", help="add milliseconds to each solution")
    parser.add_argument("--quick", action="store_true", help="fewer problems in the table")
    parser.add_argument("--no-pose", action="store_true", help="leave out the four-light pose and its peers")
    args = parser.parse_args()
    if args.cases is not None:
        if args.out is None:
            parser.error("OUT.json is missing")
        solve_file(args.cases, args.out, timed=args.time)
        return
    rows = table(quick=args.quick)
    if not args.no_pose:
        rows = chain(rows, pose_table(quick=True))
    for what, limit, measured in rows:
        print(f"{what:<66} {limit:<20} {measured}", flush=True)


if __name__ == "__main__":
    main()
