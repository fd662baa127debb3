"""Measures the skills on the simulated panel: every skill over many seeds, with a wrong panel pose.

    python -m benchmarks.manipulation [--skills lever,slider,...] [--seeds 20] [--first 1] [--error-mm 3]
    [--error-deg 1]
    python -m benchmarks.manipulation --skills knob,breaker --panel examples/kind-package/panel.toml

The second needs the package in `examples/kind-package` to be installed.

Success is judged by the simulator's truth after the skill has ended, not by the skill's report. A `done` that the truth
does not confirm counts as false.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.simcell import SimBench, open_bench
from hal.errors import CellError
from hal.panel.knob import Knob
from manipulation.skills.outcome import ObjectState, Outcome, SkillReport
from manipulation.skills.retreat import park

ANGLE_SIGMA_RAD = np.radians(1.0)  # noise of the readings that the skills receive
KNOB_SIGMA_RAD = np.radians(0.8)
SLIDER_SIGMA = 0.4  # percent of the scale: 0.4 mm
SLIDER_TOLERANCE_M = 0.0015
LEVER_TOLERANCE_RAD = np.radians(5.0)
WHEEL_TOLERANCE_RAD = np.radians(6.0)
PASS_RATIO = 0.95
PEAK_N = {
    "button": 25.0,
    "toggle": 25.0,
    "mushroom": 40.0,
    "slider": 40.0,
    "rotary": 40.0,
    "lever": 98.0,
    "handwheel": 83.0,
    "knob": 40.0,
    "breaker": 40.0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """Result of one skill with one seed."""

    skill: str
    seed: int
    is_right: bool
    outcome: str
    cause: str
    attempts: int
    peak_n: float
    sim_s: float
    wall_s: float
    error: float


Judged = tuple[SkillReport, bool, float]


def _lever(bench: SimBench) -> Judged:
    goal = "open" if bench.truth("main_valve").state == "closed" else "closed"
    angle = {"open": 0.0, "closed": np.pi / 2}[goal]

    def look() -> ObjectState:
        return bench.look("main_valve", angle_sigma_rad=ANGLE_SIGMA_RAD)

    report = bench.operate("main_valve", goal, current=look(), verify=look)
    error = float(bench.truth("main_valve").value or 0.0) - angle
    return report, abs(error) <= LEVER_TOLERANCE_RAD, error


def _slider(bench: SimBench) -> Judged:
    before = float(bench.truth("setpoint").value or 0.0)
    goal = float(bench.rng.uniform(10.0, 90.0))
    goal = goal if abs(goal - before) > 10.0 else (before + 50.0) % 100.0

    def look() -> ObjectState:
        return bench.look("setpoint", value_sigma=SLIDER_SIGMA)

    report = bench.operate("setpoint", goal, current=look(), verify=look)
    error_m = (float(bench.truth("setpoint").value or 0.0) - goal) * 1e-3
    return report, abs(error_m) <= SLIDER_TOLERANCE_M, error_m


def _button(bench: SimBench) -> Judged:
    before = float(bench.truth("start").value or 0.0)
    expected = "off" if bench.truth("run_lamp").state == "on" else "on"
    report = bench.operate("start", expected, verify=lambda: bench.look("run_lamp"))
    presses = float(bench.truth("start").value or 0.0) - before
    return report, presses == 1.0, presses - 1.0


def _toggle(bench: SimBench) -> Judged:
    goal = "off" if bench.truth("pump").state == "on" else "on"
    report = bench.operate("pump", goal, verify=lambda: bench.look("pump"))
    return report, bench.truth("pump").state == goal, 0.0


def _rotary(bench: SimBench) -> Judged:
    states = ["manual", "off", "auto"]
    now = states.index(str(bench.truth("mode").state))
    goal = states[now + 1 if now < 2 else now - 1]

    def look() -> ObjectState:
        return bench.look("mode")

    report = bench.operate("mode", goal, current=look(), verify=look)
    return report, bench.truth("mode").state == goal, 0.0


def _handwheel(bench: SimBench) -> Judged:
    before = float(bench.truth("bypass").value or 0.0)
    goal = before + (np.pi / 2 if before < 0 else -np.pi / 2)

    def look() -> ObjectState:
        return bench.look("bypass", angle_sigma_rad=ANGLE_SIGMA_RAD)

    report = bench.operate("bypass", goal, current=look(), verify=look)
    error = float(bench.truth("bypass").value or 0.0) - goal
    return report, abs(error) <= WHEEL_TOLERANCE_RAD, error


def _mushroom(bench: SimBench) -> Judged:
    report = bench.operate("emergency", "pressed", verify=lambda: bench.look("emergency"))
    return report, bench.truth("emergency").state == "pressed", 0.0


def _knob(bench: SimBench) -> Judged:
    knob = bench.context.panel.object("speed")
    assert isinstance(knob, Knob)
    scale = knob.scale
    goal = scale.minimum + float(bench.rng.uniform(0.1, 0.9)) * scale.span
    sigma = KNOB_SIGMA_RAD * scale.span / abs(scale.at_max - scale.at_min)

    def look() -> ObjectState:
        return bench.look("speed", value_sigma=sigma)

    report = bench.operate("speed", goal, current=look(), verify=look)
    error = float(bench.truth("speed").value or 0.0) - goal
    return report, abs(error) <= knob.goal.tolerance, error


def _breaker(bench: SimBench) -> Judged:
    goal = {"on": "off", "off": "on", "tripped": "on"}[str(bench.truth("feed").state)]

    def look() -> ObjectState:
        return bench.look("feed")

    report = bench.operate("feed", goal, current=look(), verify=look)
    return report, bench.truth("feed").state == goal, 0.0


SKILLS: dict[str, Callable[[SimBench], Judged]] = {
    "lever": _lever,
    "slider": _slider,
    "button": _button,
    "toggle": _toggle,
    "rotary": _rotary,
    "handwheel": _handwheel,
    "mushroom": _mushroom,
}
OTHERS: dict[str, Callable[[SimBench], Judged]] = {"knob": _knob, "breaker": _breaker}
"""Skills of kinds that the bench panel does not have."""


def trial(bench: SimBench, skill: str, seed: int) -> Trial:
    """Execute one skill and judge it."""
    wall, sim = time.perf_counter(), bench.clock.now_s()
    try:
        report, is_right, error = (SKILLS | OTHERS)[skill](bench)
        outcome, cause = str(report.outcome), report.cause
        attempts, peak = report.attempts, report.peak_force_n
    except CellError as fault:
        is_right, error, outcome, cause, attempts, peak = False, 0.0, fault.type_name, fault.what, 0, 0.0
    try:
        park(bench.context)
    except CellError as fault:
        cause = f"{cause}; park: {fault.what}"
    return Trial(
        skill=skill, seed=seed, is_right=is_right, outcome=outcome, cause=cause, attempts=attempts, peak_n=peak,
        sim_s=bench.clock.now_s() - sim, wall_s=time.perf_counter() - wall, error=error,
    )  # fmt: skip


def wilson_lower(successes: int, trials: int, z: float = 1.96) -> float:
    """Return the lower end of the 95 % confidence interval of a proportion (Wilson, JASA 22, 1927)."""
    if trials == 0:
        return 0.0
    p = successes / trials
    centre = p + z * z / (2 * trials)
    spread = z * np.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    return float((centre - spread) / (1 + z * z / trials))


def table(trials: list[Trial]) -> str:
    """Return one line per skill, with the pass line beside the measured value."""
    head = (
        f"{'skill':10} {'right':>8} {'pass':>6} {'wilson':>7} {'first':>6} {'false':>6} {'peak med/max N':>16} "
        f"{'limit':>6} {'sim s':>6} {'RTF':>5}  outcomes"
    )
    lines = [head]
    for skill in dict.fromkeys(t.skill for t in trials):
        rows = [t for t in trials if t.skill == skill]
        right = sum(t.is_right for t in rows)
        false = sum(t.outcome == Outcome.DONE and not t.is_right for t in rows)
        first = sum(t.is_right and t.attempts == 1 for t in rows)
        peaks = [t.peak_n for t in rows]
        wall = sum(t.wall_s for t in rows)
        verdict = "ok" if right >= PASS_RATIO * len(rows) else "FAIL"
        sim = [t.sim_s for t in rows]
        counts = dict(Counter(t.outcome for t in rows))
        lines.append(
            f"{skill:10} {right:4}/{len(rows):<3} {verdict:>6} {wilson_lower(right, len(rows)):7.2f} {first:6} "
            f"{false:6} {np.median(peaks):8.1f}/{max(peaks):5.1f}   {PEAK_N[skill]:6.0f} {np.median(sim):6.1f} "
            f"{sum(sim) / wall:5.2f}  {counts}"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--skills", default=",".join(SKILLS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--panel", type=Path, help="a panel file other than the bench cell's")
    parser.add_argument("--error-mm", type=float, default=3.0)
    parser.add_argument("--error-deg", type=float, default=1.0)
    options = parser.parse_args()
    trials: list[Trial] = []
    for seed in range(options.first, options.first + options.seeds):
        bench = open_bench(
            seed, error_m=options.error_mm * 1e-3, error_rad=np.radians(options.error_deg), panel=options.panel
        )
        try:
            for skill in options.skills.split(","):
                result = trial(bench, skill, seed)
                trials.append(result)
                mark = "right" if result.is_right else "WRONG"
                print(
                    f"{seed:4} {skill:10} {mark} {result.outcome:11} tries {result.attempts} "
                    f"peak {result.peak_n:5.1f} N error {result.error:+.4f} sim {result.sim_s:5.1f} s  {result.cause}",
                    flush=True,
                )
        finally:
            bench.close()
    print(table(trials))


if __name__ == "__main__":
    main()
