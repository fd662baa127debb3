"""Shows the faults F1 to F38: `python -m benchmarks.faults [--seeds 5] [--only F12] [--chaos]`.

Each fault of `faults.toml` has tests, which run once for each seed: it seeds the hashes of Python, Hypothesis and the order of the
tests. With `--chaos`, the faults of `panelwright chaos` that belong to it come in as many missions. Prints a table and
the pass line; the exit code is 1 if a fault is not survived.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from benchmarks.kills import chaos_rounds

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_name("faults.toml")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print; return 1 if a fault is not survived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="one fault")
    parser.add_argument("--chaos", action="store_true", help="also break a running simulated cell")
    given = parser.parse_args(arguments)
    seeds = range(1, given.seeds + 1)
    survived = 0
    chosen = {name: row for name, row in table().items() if given.only in ("", name)}
    failed = {seed: failures([test for row in chosen.values() for test in row["tests"]], seed) for seed in seeds}
    print("| fault | what | tests | chaos | survived with seeds |")
    print(f"|{' --- |' * 5}", flush=True)
    told: list[str] = []
    for name, row in chosen.items():
        wrong = {seed: sorted(failed[seed] & set(row["tests"])) for seed in seeds if failed[seed] & set(row["tests"])}
        broken = _broken(row.get("chaos", []), given.seeds) if given.chaos else []
        survived += not wrong and not broken
        told += [f"{name}, seed {seed}: {test}" for seed, tests in wrong.items() for test in tests]
        told += [f"{name}: {breach}" for breach in broken]
        good = [str(seed) for seed in seeds if seed not in wrong]
        shown = ", ".join(row.get("chaos", [])) if given.chaos else ""
        print(f"| {name} | {row['what']} | {len(row['tests'])} | {shown} | {', '.join(good)} |", flush=True)
    print("\n".join(told))
    print(f"{survived} of {len(chosen)} faults with {len(seeds)} seeds (pass: all), load {os.getloadavg()[0]:.0f}")
    return int(survived < len(chosen))


def table() -> dict[str, dict[str, Any]]:
    """Return the rows of the table by fault."""
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


def failures(tests: Sequence[str], seed: int) -> set[str]:
    """Run tests with a seed, in an order that it draws; returns those that failed or did not run."""
    order = random.Random(seed).sample(tests, len(tests))
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        options = [
            "-n",
            "0",
            "-q",
            "-p",
            "no:cacheprovider",
            f"--hypothesis-seed={seed}",
            "--hypothesis-profile=seeded",
        ]
        subprocess.run(
            [sys.executable, "-m", "pytest", *options, f"--junitxml={report}", *order],
            cwd=ROOT,
            stdout=sys.stderr,
            check=False,
            env={**os.environ, "PYTHONHASHSEED": str(seed)},
        )
        return set(tests) - passed(report.read_text(encoding="utf-8"))


def passed(report: str) -> set[str]:
    """Return the tests of a JUnit report that passed with all their parameters, as pytest names them."""
    good: set[str] = set()
    bad: set[str] = set()
    for case in ElementTree.fromstring(report).iter("testcase"):  # noqa: S314 - written by our own pytest
        file = str(case.get("classname")).replace(".", "/") + ".py"
        name = f"{file}::{str(case.get('name')).partition('[')[0]}"
        (bad if len(case) else good).add(name)
    return good - bad


def _broken(faults: Sequence[str], times: int) -> list[str]:
    """Break a running cell with each fault; returns the breaches."""
    found = []
    for number, fault in enumerate(faults):
        with tempfile.TemporaryDirectory() as folder:
            rounds = chaos_rounds((fault,), times, seed=number + 1, cell=ROOT / "cells/bench.toml", folder=Path(folder))
        found += [f"{fault}: {breach}" for one in rounds for breach in one.breaches]
    return found


if __name__ == "__main__":
    raise SystemExit(main())
