"""Figures of the plant, each with its pass line: `python -m benchmarks.plant [SUBJECT ...]`; without a subject, all of them.

Subjects: durable, trend, rounds, anomalies, conditions, certificate, regime. The first two measure times, which a quiet machine
gives; `rounds` starts a real service sixty times (a quarter of an hour). `--first` is the seed.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import plant_rounds, plant_service, plant_statistics

SEED = 9001


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A measured figure in words, with its pass line, and whether it holds."""

    says: str
    line: str
    holds: bool


def durable(given: argparse.Namespace) -> Figure:
    """Measure a reading until it is visible."""
    found = plant_service.durable(missions=given.missions, clients=given.clients)

    def told(times_s: Sequence[float]) -> str:
        return " / ".join(f"{1e3 * float(x):.1f}" for x in np.quantile(times_s, (0.5, 0.99)))

    says = (
        f"a reading is on disk and a new question sees it after {told(found.stored_s)} ms (median / p99), the first of "
        f"{found.clients} followers is told after {told(found.first_s)} ms, each of them after {told(found.each_s)} ms, of which "
        f"the followers themselves cost {told(found.floor_s)} ms; 4 kB of a process that does nothing else are on disk after "
        f"{told(found.disk_s)} ms; {len(found.stored_s)} readings, {found.missions} missions, "
        f"outlets: {', '.join(found.outlets)}"
    )
    p99_s = float(np.quantile(np.maximum(found.stored_s, found.first_s), 0.99))
    return Figure(says=says, line="p99 5 ms until it is on disk, visible and told first", holds=p99_s <= 0.005)


def trend(_given: argparse.Namespace) -> Figure:
    """Measure the trend of a year."""
    times = 1e3 * np.array(plant_service.trend())
    said = f"{np.median(times):.0f} ms (median), {times.max():.0f} ms (longest)"
    says = f"the trend of one of 20 objects over a year of hours: {said}"
    return Figure(says=says, line="300 ms", holds=bool(times.max() <= 300.0))


def rounds(given: argparse.Namespace) -> Figure:
    """Count the runs of a month that were missed, doubled or shifted."""
    found = plant_rounds.month(given.first, days=given.days, restarts=given.restarts, kills=given.kills)
    says = (
        f"{given.days:g} days, {found.due} runs, {found.restarts} restarts, kill -9 of {dict(found.kills)}: {found.missed} missed, "
        f"{found.doubled} doubled, {found.shifted} shifted ({found.interrupted} interrupted in their middle)"
    )
    return Figure(says=says, line="0, 0, 0", holds=found.holds)


def anomalies(given: argparse.Namespace) -> Figure:
    """Count planted anomalies that were found, and false alarms."""
    found, false = plant_statistics.anomalies(given.first)
    says = f"{found} of 200 planted anomalies found, {false} false alarms in 10,000 readings"
    return Figure(says=says, line="198, 10", holds=found >= 198 and false <= 10)


def conditions(given: argparse.Namespace) -> Figure:
    """Count deeds that began on a condition that was not met for certain."""
    begun, wrong = plant_statistics.conditions(given.first)
    says = (
        f"1000 random mission files with random faults: {begun} deeds begun, {wrong} on an unmet or unknown condition"
    )
    return Figure(says=says, line="0", holds=wrong == 0 and begun > 500)


def certificate(given: argparse.Namespace) -> Figure:
    """Count the splits in which the bound fails."""
    fails = plant_statistics.certificate(given.first)
    return Figure(says=f"the bound fails in {fails} of 400 re-splits at 2 %", line="28", holds=fails <= 28)


def regime(given: argparse.Namespace) -> Figure:
    """Count pictures outside of the regime that carry a certificate."""
    wrong, inside = plant_statistics.regime(given.first)
    says = f"{wrong} of 1000 pictures outside of the regime carry a certificate ({inside} of 1000 inside of it)"
    return Figure(says=says, line="10", holds=wrong <= 10)


SUBJECTS: dict[str, Callable[[argparse.Namespace], Figure]] = {
    one.__name__: one for one in (anomalies, conditions, certificate, regime, trend, durable, rounds)
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT", choices=[*SUBJECTS, []])
    parser.add_argument("--first", type=int, default=SEED, help="seed")
    parser.add_argument("--missions", type=int, default=3, help="durable: how many run")
    parser.add_argument("--clients", type=int, default=50, help="durable: how many follow the feed")
    parser.add_argument("--days", type=float, default=30.0, help="rounds: length of the month")
    parser.add_argument("--restarts", type=int, default=40, help="rounds: of the service")
    parser.add_argument("--kills", type=int, default=20, help="rounds: kill -9 of any process")
    given = parser.parse_args(arguments)
    failed = 0
    for name in given.subjects or SUBJECTS:
        figure = SUBJECTS[name](given)
        failed += not figure.holds
        print(f"{name}: {figure.says} (pass: {figure.line}): {'holds' if figure.holds else 'FAILS'}", flush=True)
    print(f"seed {given.first}; load of the last minute {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
