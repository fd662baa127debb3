"""Measures drivers with their emulators and writes their records: `python -m benchmarks.drivers.record [DRIVER...]`.

The parts are the conformance kit and the tests with third-party software (`tests/drivers`), the fault matrix, re-plugging
and time stamps. A part that is left out (`--only`) keeps the result of the record that is there.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.benches import BENCHES
from benchmarks.drivers.faults import MIXED, RATES, Cell, Key, matrix
from benchmarks.drivers.life import unplugging
from benchmarks.drivers.realtime import REALTIME, realtime
from benchmarks.drivers.stamps import stamp_errors_s
from hal.entry_points import registered
from hal.errors import CellError
from hal.gc_freeze import freeze_loaded
from hal.registry import DEVICES
from service.commissioning.driver_options import describe
from service.commissioning.driver_records import (
    Conformance,
    Docs,
    DriverRecord,
    FaultMatrix,
    Replug,
    Setup,
    Stamps,
    ThirdParty,
    installed_record,
    tier_of,
    write_record,
)
from service.processes.cell import SWITCH_S

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "drivers" / "records"
PARTS = ("tests", "faults", "replug", "stamps")
WINDOWS = 5  # the median of their percentiles counts, because a burst of other work may spoil one of them


def main() -> None:
    """Measure the named drivers, or all that are not simulated."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drivers", nargs="*")
    parser.add_argument(
        "--seconds", type=float, default=2.0, help="for each cell of the fault matrix and each window of stamps"
    )
    parser.add_argument("--unplugs", type=int, default=20)
    parser.add_argument("--only", default=",".join(PARTS), help=f"comma list of {', '.join(PARTS)}")
    arguments = parser.parse_args()
    known = [name for name in registered(DEVICES) if not name.startswith("sim:")]
    drivers, parts = arguments.drivers or known, arguments.only.split(",")
    if unknown := [*(set(drivers) - set(known)), *(set(parts) - set(PARTS))]:
        sys.exit(f"unknown: {', '.join(unknown)}; drivers: {', '.join(known)}; parts: {', '.join(PARTS)}")
    sys.setswitchinterval(SWITCH_S)  # both as in the cell process
    freeze_loaded()
    records = {name: _begun(name) for name in drivers}
    if "tests" in parts:
        records = with_tests(records)
    benches = [bench for bench in BENCHES if bench.driver in drivers]
    cells = matrix(benches, arguments.seconds) if "faults" in parts and benches else {}
    for name, record in records.items():
        mine = [bench for bench in benches if bench.driver == name]
        setups = {b.name: measured(b, record.setups.get(b.name, Setup()), cells, arguments, parts) for b in mine}
        done = record.model_copy(update={"setups": setups})
        write_record(RECORDS, done)
        print(f"{name:<28} {tier_of(done)}", flush=True)


def _begun(name: str) -> DriverRecord:
    """Return the record of a driver as far as it goes without measuring, with what is kept of the one before."""
    before = installed_record(name)
    text = (ROOT / "docs" / "reference" / "drivers.md").read_text(encoding="utf-8")
    is_explained = any(
        re.search(rf"{re.escape(name)}(?!\w)", line) for line in re.findall(r"^### .*$", text, re.MULTILINE)
    )
    undescribed = tuple(option.key for option in describe(name).options if not option.description)
    return DriverRecord(
        driver=name,
        date=datetime.now(UTC).date().isoformat(),
        panelwright=version("panelwright"),
        python=platform.python_version(),
        machine=f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.0f}",
        docs=Docs(has_section=is_explained, undescribed=undescribed),
        conformance=None if before is None else before.conformance,
        third_party=() if before is None else before.third_party,
        setups={} if before is None else before.setups,
        hardware=() if before is None else before.hardware,
    )


def with_tests(records: dict[str, DriverRecord]) -> dict[str, DriverRecord]:
    """Run the tests that concern some drivers, and return their records with the results."""
    found = evidence(test_files(records))
    return {name: record.model_copy(update=_results(name, found)) for name, record in records.items()}


def test_files(drivers: Iterable[str]) -> list[Path]:
    """Return the files of `tests/drivers` in which one of the drivers is named."""
    word = re.compile("|".join(map(re.escape, drivers)))
    return [path for path in sorted((ROOT / "tests" / "drivers").rglob("test_*.py")) if word.search(path.read_text())]


def evidence(files: list[Path]) -> list[dict[str, Any]]:
    """Run conformance tests and tests with third-party software; returns test, outcome, drivers and package of each."""
    if not files:
        return []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "evidence.json"
        options = ["-p", "benchmarks.drivers.evidence", "--evidence", str(out), "-q", "--numprocesses", "2"]
        chosen = ["-m", "conformance or third_party", "--dist", "loadscope"]
        command = [sys.executable, "-m", "pytest", *options, *chosen, *map(str, files)]
        subprocess.run(command, cwd=ROOT, check=False, stdout=sys.stderr)
        found: list[dict[str, Any]] = json.loads(out.read_text())
        return found


def _results(driver: str, found: list[dict[str, Any]]) -> dict[str, Any]:
    mine = [one for one in found if driver in one["drivers"]]
    kit = [one for one in mine if one["package"] is None]
    third = [one for one in mine if one["package"] is not None and one["outcome"] != "skipped"]
    counts = {
        word: [_short(one["test"]) for one in kit if one["outcome"] == word] for word in ("passed", "skipped", "failed")
    }
    return {
        "conformance": Conformance(
            passed=len(counts["passed"]), skipped=len(counts["skipped"]), failed=tuple(counts["failed"])
        )
        if kit
        else None,
        "third_party": tuple(
            ThirdParty(
                package=one["package"],
                version=_version(one["package"]),
                test=_short(one["test"]),
                passed=one["outcome"] == "passed",
            )
            for one in third
        ),
    }


def _short(node: str) -> str:
    return node.partition("tests/drivers/")[2] or node


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "of the system"


def measured(
    item: Bench, before: Setup, cells: dict[Key, Cell], arguments: argparse.Namespace, parts: list[str]
) -> Setup:
    """Return one setup with the parts that were asked for measured anew."""
    faults, replug, stamps = before.faults, before.replug, before.stamps
    if cells:
        faults = faults_of(item, cells, arguments.seconds)
    with realtime(REALTIME, os.getpid()):  # or as it is, where the system does not permit it
        if "replug" in parts:
            replug = replug_of(item, arguments.unplugs)
        if "stamps" in parts:
            stamps = stamps_of(item, arguments.seconds)
    return Setup(faults=faults, replug=replug, stamps=stamps)


def faults_of(item: Bench, cells: dict[Key, Cell], seconds: float) -> FaultMatrix:
    """Return the sums over all cells of one setup."""
    mine = {
        (fault, every): cells[item.name, fault, every] for every in RATES for fault in (*map(str, item.faults), MIXED)
    }
    total = Cell()
    for cell in mine.values():
        total.add(cell)
    return FaultMatrix(
        cells=len(mine),
        seconds_per_cell=seconds,
        good=total.good,
        errors=total.errors,
        wrong=total.wrong,
        stale=total.stale,
        hung=total.late_calls,
        untyped=total.untyped,
        blind=tuple(f"{fault}, every {every}" for (fault, every), cell in mine.items() if not cell.good),
    )


def replug_of(item: Bench, times: int) -> Replug | None:
    """Unplug the setup repeatedly; None if it has no plug or the driver does not connect."""
    if not item.is_plugged:
        return None
    try:
        found = unplugging(item, times)
    except CellError as error:
        print(f"    {item.name}: not re-plugged: {error}")
        return None
    return Replug(
        times=times,
        worst_s=round(max(found.back_s), 4),
        leaked_descriptors=found.leaked_descriptors,
        leaked_threads=found.leaked_threads,
    )


def stamps_of(item: Bench, seconds: float) -> Stamps | None:
    """Measure the stamps of the setup in some windows; None where nothing shows the true time."""
    if item.stamps is None:
        return None
    try:
        windows = [stamp_errors_s(item, seconds) for _ in range(WINDOWS)]
    except CellError as error:
        print(f"    {item.name}: no stamps: {error}")
        return None
    p99_s = float(np.median([np.quantile(errors_s, 0.99) for errors_s in windows]))
    return Stamps(samples=sum(map(len, windows)), p99_s=round(p99_s, 6))


if __name__ == "__main__":
    main()
