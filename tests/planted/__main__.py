"""Plants each defect in a scratch copy and runs the nearest tests, which must fail: `make test-planted`.

A defect counts as found when a test fails (pytest ends with 1) or hangs. An error while tests are collected is no find: it
ends the run, because the list is wrong then. The exit code is 0 when at least `--least` defects were found.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.planted.defects import ROOT, Defect, all_defects

LONGEST_S = 300.0
FAILED = 1  # exit code of pytest when tests ran and some failed
FOUND, SURVIVED, BROKEN = "found", "SURVIVED", "BROKEN"


def main() -> None:
    """Run the defects whose name or file contains one of the given words, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only defects whose name or file contains one of them")
    parser.add_argument("--first", type=int, default=1, help="begin with this one of the list")
    parser.add_argument("--least", type=int, default=None, help="how many must be found; all by default")
    parser.add_argument("--no-baseline", action="store_true", help="do not run the tests on the sound sources first")
    options = parser.parse_args()
    chosen = [d for d in all_defects() if not options.words or any(w in d.name or w in d.file for w in options.words)]
    chosen = chosen[options.first - 1 :]
    with tempfile.TemporaryDirectory(prefix="panelwright-planted-") as folder:
        scratch = Path(folder) / "copy"
        _copy(scratch)
        _check_imports(scratch)
        if not options.no_baseline:
            _check_baseline(scratch, chosen)
        verdicts = [_try(scratch, number, len(chosen), defect) for number, defect in enumerate(chosen, 1)]
    found = verdicts.count(FOUND)
    print(f"{found} of {len(chosen)} planted defects were found")
    for defect, verdict in zip(chosen, verdicts, strict=True):
        if verdict != FOUND:
            print(f"{verdict}: {defect.name} ({defect.file})")
    least = len(chosen) if options.least is None else options.least
    sys.exit(0 if found >= least and BROKEN not in verdicts else 1)


def _copy(scratch: Path) -> None:
    """Copy what git knows, and new files that it does not ignore."""
    names = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    for name in filter(None, names.split("\0")):
        source, target = ROOT / name, scratch / name
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)


def _python(scratch: Path, *arguments: str, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Run this interpreter so that it and its children import the copy."""
    environment = {**os.environ, "PYTHONPATH": str(scratch)}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=scratch, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False,
    )  # fmt: skip


def _check_imports(scratch: Path) -> None:
    """Refuse to go on if the tests would import other sources than the copy."""
    asked = "import hal, manipulation, service; print(hal.__file__, manipulation.__file__, service.__file__)"
    said = _python(scratch, "-c", asked, timeout_s=LONGEST_S).stdout.split()
    if len(said) != 3 or not all(Path(path).is_relative_to(scratch) for path in said):
        raise SystemExit(f"the tests would not import the copy, but {' '.join(said)}")


def _check_baseline(scratch: Path, chosen: list[Defect]) -> None:
    """Refuse to go on if the tests fail without any defect, because a failure would say nothing then."""
    tests = list(dict.fromkeys(test for defect in chosen for test in defect.tests))
    done = _pytest(scratch, tests, timeout_s=4 * LONGEST_S)
    print(f"without a defect: {done.stdout.strip().splitlines()[-1]}", flush=True)
    if done.returncode != 0:
        raise SystemExit(done.stdout + done.stderr)


def _pytest(scratch: Path, tests: list[str], *, timeout_s: float) -> subprocess.CompletedProcess[str]:
    return _python(scratch, "-m", "pytest", "-n", "0", "-x", "--tb=line", *tests, timeout_s=timeout_s)


def _try(scratch: Path, number: int, total: int, defect: Defect) -> str:
    path = scratch / defect.file
    sound = path.read_text(encoding="utf-8")
    begun_s = time.monotonic()
    try:
        _write(path, defect.planted(sound))
        done = _pytest(scratch, list(defect.tests), timeout_s=LONGEST_S)
        verdict = {0: SURVIVED, FAILED: FOUND}.get(done.returncode, BROKEN)
        detail = next((line for line in done.stdout.splitlines() if line.startswith("FAILED")), "")
        if verdict == BROKEN:
            print(done.stdout + done.stderr)
    except subprocess.TimeoutExpired:
        verdict, detail = FOUND, "the tests hang"
    finally:
        _write(path, sound)
    print(f"{number:3} of {total}  {verdict:8} {time.monotonic() - begun_s:5.1f} s  {defect.name}", flush=True)
    if detail:
        print(f"{' ' * 13}{detail}", flush=True)
    return verdict


def _write(path: Path, source: str) -> None:
    """Write a source, and remove its bytecode: Python compares whole seconds and would keep that of the text before."""
    path.write_text(source, encoding="utf-8")
    Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)


if __name__ == "__main__":
    main()
