"""Nine-class fusion against its bound, mismatches, brute force, the clock and its peers.

python -m benchmarks.fusion CASES.json OUT.json [--time]    solve a file of cases (schema of data/fusion)
python -m benchmarks.fusion [--quick]                       print the table, pass line beside measured value
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import FusedPose, Measurement, SensingClass, fuse, warm_up
from fusion.certify import certificate
from fusion.distance import local_value, local_values
from fusion.errors import Contradiction
from fusion.reference import brute_force, residual
from fusion.robust import used_entries
from fusion.simulate import CODES, TABLE_II, Problem, problem
from fusion.solve import solve, solve_from_many
from hal.geometry import Array, difference, matrix_of, perturbed, transform

ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])  # the case files put rotation first, the cell translation
NEAR_M, NEAR_RAD = 0.005, np.radians(1.0)
Row = tuple[str, str, str]


# --- case files ------------------------------------------------------------------------------------------------------


def measurement_of(value: dict[str, Any]) -> Measurement:
    """One measurement of a case file; reads neither `outlier` nor anything else that a solver must not know."""
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
    """The answer to one case in the scorer's schema (rotation first), or None where fusion refuses."""
    measurements = [measurement_of(m) for m in case["measurements"]]
    started_s = time.perf_counter()
    try:
        answer = fuse(measurements)
    except Contradiction:
        return None
    ms = (time.perf_counter() - started_s) * 1e3
    made: dict[str, Any] = {
        "R": matrix_of(answer.pose).tolist(),
        "t": answer.pose.translation.tolist(),
        "cov": answer.covariance[np.ix_(ROTATION_FIRST, ROTATION_FIRST)].ravel().tolist(),
        "outliers": _mismatched(answer),
        "alternatives": [
            {"R": matrix_of(a.pose).tolist(), "t": a.pose.translation.tolist(), "odds": a.odds}
            for a in answer.alternatives
        ],
        "unobservable": [free.words for free in answer.unobservable],
    }
    # Exactness is judged at the true pose, which a case file gives for that purpose alone.
    if "R_true" in case:
        made["f"] = local_values(measurements, transform(case["R_true"], case["t_true"])).tolist()
    return made | {"ms": ms} if timed else made


def _mismatched(answer: FusedPose) -> list[int]:
    return [r.index for r in answer.rejected if r.reason == "mismatch" and r.index >= 0]


def solve_file(cases_file: Path, out_file: Path, *, timed: bool) -> None:
    """Write the solutions of a case file; refused cases are left out."""
    warm_up()
    cases = json.loads(cases_file.read_text())["cases"]
    answers = {case["id"]: solution(case, timed=timed) for case in cases}
    out_file.write_text(json.dumps({k: v for k, v in answers.items() if v is not None}))
    refused = [k for k, v in answers.items() if v is None]
    print(f"{len(answers) - len(refused)} solved, {len(refused)} refused{': ' if refused else ''}{', '.join(refused)}")


# --- figures ---------------------------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class Tally:
    """What a family of simulated problems came to."""

    count: int = 0
    near: int = 0
    refused: int = 0
    bad: int = 0
    named: int = 0
    good: int = 0
    dropped: int = 0
    nees: list[float] = field(default_factory=list)
    position: list[float] = field(default_factory=list)
    rotation: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    def add(self, made: Problem) -> FusedPose | None:
        """Solve one problem and count."""
        self.count += 1
        started_s = time.perf_counter()
        try:
            answer = fuse(made.measurements)
        except Contradiction:
            self.refused += 1
            return None
        self.ms.append((time.perf_counter() - started_s) * 1e3)
        delta = difference(made.base_from_object, answer.pose)
        self.near += is_near(delta)
        named = set(_mismatched(answer))
        self.bad, self.named = self.bad + len(made.bad), self.named + len(named & made.bad)
        self.good += len(made.measurements) - len(made.bad)
        self.dropped += len(named - made.bad)
        if not made.bad and not answer.unobservable:
            self.nees.append(float(delta @ np.linalg.solve(answer.covariance, delta)))
            bound = solve(made.measurements, made.base_from_object).covariance
            self.position.append(float(delta[:3] @ delta[:3] / np.trace(bound[:3, :3])))
            self.rotation.append(float(delta[3:] @ delta[3:] / np.trace(bound[3:, 3:])))
        return answer


def is_near(delta: Array) -> bool:
    """Success as the scorer counts it: 5 mm and 1 degree. `delta`: (6,) m and rad."""
    return bool(np.linalg.norm(delta[:3]) < NEAR_M and np.linalg.norm(delta[3:]) < NEAR_RAD)


def codes(rng: np.random.Generator, count: int) -> list[str]:
    """Random kinds of sensing."""
    return [CODES[k] for k in rng.integers(len(CODES), size=count)]


def mixed(count: int, bad: int, problems: int, rng: np.random.Generator, *, anisotropy: float = 1.0) -> Tally:
    """Fuse `problems` random mixtures of `count` measurements of which `bad` are mismatched."""
    tally = Tally()
    for _ in range(problems):
        tally.add(problem(codes(rng, count), rng, bad=bad, anisotropy=anisotropy))
    return tally


def exactness(per_class: int, rng: np.random.Generator) -> list[Row]:
    """Largest relative difference from brute force for random SPD C (condition up to 1e4) and PSD M, by class."""
    worst = 0.0
    for cls in SensingClass:
        for _ in range(per_class):
            m, pose = random_measurement(cls, rng), transform(_rotation(rng), rng.normal(0, 0.3, 3))
            f = brute_force(m, pose)
            worst = max(worst, abs(local_value(m, pose) - f) / (1e-3 + f))
    return [("nine local pose functions against brute force, relative", "<= 1e-6", f"{worst:.1e}")]


def random_measurement(cls: SensingClass, rng: np.random.Generator) -> Measurement:
    """Any feature, place, SPD C and rank-two M, all over three decades."""
    A, B = _rotation(rng), _rotation(rng)
    C = A @ np.diag(np.exp(rng.uniform(-11.5, -2.3, 3))) @ A.T
    M = B @ np.diag([0.0, *np.exp(rng.uniform(0.0, 13.8, 2))]) @ B.T
    u = rng.normal(size=3)
    return Measurement(
        cls=cls, x_m=rng.normal(0, 0.3, 3), u=u / np.linalg.norm(u), mu_m=rng.normal(0, 0.3, 3),
        C_m2=C, M=M if cls >= 4 else np.zeros((3, 3)),
    )  # fmt: skip


def _rotation(rng: np.random.Generator) -> Array:
    return np.asarray(Rotation.random(rng=rng).as_matrix())


def consistency(problems: int, rng: np.random.Generator) -> list[Row]:
    """Efficiency and consistency without mismatches: N = 16, N = 10, and N = 12 with condition 100."""
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
    """Success, recall and false rejection with mismatched measurements; and what all-bad sets do."""
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
    """The paper's sequence with its first measurement mismatched."""
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
            named.append(_mismatched(answer) == [0])
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
    """How often the relaxation of a problem without mismatches is a pose, and what it costs."""
    tight, ms = 0, []
    for _ in range(problems):
        made = problem(codes(rng, 16), rng)
        answer = fuse(made.measurements)
        b, used, local = used_entries(made.measurements, answer)
        started_s = time.perf_counter()
        tight += certificate(b, used, local).tight
        ms.append((time.perf_counter() - started_s) * 1e3)
    return [
        ("certificate tight without mismatches", ">= 99 %", f"{tight / problems:.1%} of {problems}"),
        ("certificate, time", "<= 8 ms", f"{np.median(ms):.2f} ms (best {np.min(ms):.2f})"),
    ]


def clock(rng: np.random.Generator) -> list[Row]:
    """Medians over problems with N = 16, from measurement objects to answer."""
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
        started_s = time.perf_counter()
        run(k)
        times.append((time.perf_counter() - started_s) * 1e3)
    return times


# --- peers -----------------------------------------------------------------------------------------------------------


def peers(problems: int, rng: np.random.Generator) -> list[Row]:
    """Plain least squares with one bad measurement (the 1990 objective), and gtsam on the same rows."""
    near = sum(
        is_near(difference(p.base_from_object, solve_from_many(p.measurements, starts=32).base_from_object))
        for p in (problem(codes(rng, 16), rng, bad=1) for _ in range(problems))
    )
    rows: list[Row] = [("peer: least squares over all, N=16 with 1 bad", "-", f"success {near / problems:.0%}")]
    try:
        import gtsam  # noqa: F401
    except ImportError:
        return [*rows, ("peer: gtsam", "-", "not installed")]
    apart, ratio = [], []
    for _ in range(problems):
        made = problem([c for c in codes(rng, 40) if c[0] in "12359"][:16], rng)
        start = perturbed(made.base_from_object, rng.normal(0, 0.01, 6))
        started_s = time.perf_counter()
        mine = solve(made.measurements, start)
        middle_s = time.perf_counter()
        theirs = _gtsam(made.measurements, start)
        ratio.append((time.perf_counter() - middle_s) / (middle_s - started_s))
        apart.append(float(np.linalg.norm(difference(theirs, mine.base_from_object)[:3])))
    return [*rows, ("peer: gtsam, Python factors of the exact classes", "-",
                    f"same place within {np.max(apart):.1e} m, time x{np.median(ratio):.0f}")]  # fmt: skip


def _gtsam(measurements: Sequence[Measurement], start: RigidTransform) -> RigidTransform:
    import gtsam

    graph, key = gtsam.NonlinearFactorGraph(), 0

    def factor(m: Measurement) -> Any:
        def error(_: Any, values: Any, jacobians: list[Array] | None) -> Array:
            pose = values.atPose3(key)
            r = residual(m, pose.rotation().matrix(), pose.translation())
            if jacobians is not None:
                jacobians[0] = np.column_stack([_slope(m, pose, axis) for axis in np.eye(6)])
            return r

        rows = m.dof
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), [key], error)

    for m in measurements:
        graph.add(factor(m))
    initial = gtsam.Values()
    initial.insert(key, gtsam.Pose3(gtsam.Rot3(matrix_of(start)), start.translation))
    pose = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize().atPose3(key)
    return transform(pose.rotation().matrix(), pose.translation())


def _slope(m: Measurement, pose: Any, axis: Array) -> Array:
    forward, back = pose.retract(1e-6 * axis), pose.retract(-1e-6 * axis)
    ahead = residual(m, forward.rotation().matrix(), forward.translation())
    return np.asarray((ahead - residual(m, back.rotation().matrix(), back.translation())) / 2e-6)


def table(*, quick: bool) -> list[Row]:
    """Rows of (what, pass line, measured)."""
    rng = np.random.default_rng(20)
    warm_up()
    n = 60 if quick else 250
    return [
        *exactness(1 if quick else 4, rng),
        *consistency(n if quick else 400, rng),
        *mismatches(30 if quick else 150, rng),
        *table_ii(6 if quick else 20, rng),
        *certificates(30 if quick else 200, rng),
        *clock(rng),
        *peers(10 if quick else 25, rng),
    ]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="?")
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--time", action="store_true", help="add milliseconds to each solution")
    parser.add_argument("--quick", action="store_true", help="fewer problems in the table")
    args = parser.parse_args()
    if args.cases is not None:
        if args.out is None:
            parser.error("OUT.json is missing")
        solve_file(args.cases, args.out, timed=args.time)
        return
    rows = table(quick=args.quick)
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    for what, limit, measured in rows:
        print(f"{what:<{widths[0]}}  {limit:<{widths[1]}}  {measured}")


if __name__ == "__main__":
    main()
