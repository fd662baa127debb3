"""Computes fingerprints of the product's answers, to prove that a change of structure does not change them.

python -m benchmarks.fingerprint OUT.json               missions 1-3 and the development cases of every subject
python -m benchmarks.fingerprint OUT.json --against REF.json   the same, and exit code 1 where a fingerprint differs

A fingerprint is the SHA-256 of an answer file without its times. `OUT.json` contains the answers beside the
fingerprints, so that differences can be examined. The cases are those of `../shared/data`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
SEEDS = (1, 2, 3)
TIMES = frozenset({"ms", "milliseconds", "seconds", "time_s", "took_s", "wall_s"})
DIGITS = 9  # significant digits kept; differences beyond come from the order of a sum
MISSION_PARTS = ("actions", "readings", "fused", "cell_s", "peak_force_n", "judge")


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the fingerprints; return 1 if one differs from the reference's."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--only", help="missions, fusion, pose, vision or range")
    given = parser.parse_args(arguments)
    known: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for subject, measure in SUBJECTS.items():
            if given.only in (None, subject):
                known |= {name: entry(answer) for name, answer in measure(Path(folder)).items()}
                print(*(f"{name} {known[name]['sha256'][:16]}" for name in known if name.startswith(subject)), sep="\n")
    given.out.write_text(json.dumps(known, indent=1), encoding="utf-8")
    if given.against is None:
        return 0
    reference = json.loads(given.against.read_text(encoding="utf-8"))
    differing = [name for name in known if reference.get(name, {}).get("sha256") != known[name]["sha256"]]
    print("all the same" if not differing else f"different: {', '.join(differing)}")
    return 1 if differing else 0


def entry(answer: Any) -> dict[str, Any]:
    """Return an answer with its fingerprint."""
    plain = without_times(answer)
    text = json.dumps(plain, sort_keys=True)
    return {"sha256": hashlib.sha256(text.encode()).hexdigest(), "answer": plain}


def without_times(value: Any) -> Any:
    """Return the JSON value without measured times, with numbers rounded to `DIGITS` significant digits."""
    if isinstance(value, dict):
        return {key: without_times(part) for key, part in value.items() if key not in TIMES}
    if isinstance(value, list):
        return [without_times(part) for part in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def missions(folder: Path) -> dict[str, Any]:
    """Return the readings, actions and fusion results of missions 1-3 on the bench cell, and the judge's verdicts."""
    out: dict[str, Any] = {}
    for seed in SEEDS:
        runs = folder / f"mission{seed}"
        _python("-m", "service.cli", "demo", "--seed", str(seed), "--judge", "--runs", str(runs))
        (report,) = runs.glob("*/report.json")
        record = json.loads(report.read_text(encoding="utf-8"))
        out[f"missions {seed}"] = {part: record.get(part) for part in MISSION_PARTS}
    return out


def fusion(folder: Path) -> dict[str, Any]:
    """Return the solutions of the nine-class development cases."""
    return {"fusion": _answers("benchmarks.fusion", DATA / "fusion" / "dev_cases.json", folder / "fusion.json")}


def pose(folder: Path) -> dict[str, Any]:
    """Return the solutions of the four-light development problems."""
    return {"pose": _answers("benchmarks.pose", DATA / "pose" / "dev_quads.json", folder / "pose.json")}


def vision(folder: Path) -> dict[str, Any]:
    """Return the answers to the drawn and the photographed development images."""
    out: dict[str, Any] = {}
    for images in ("synth_dev", "real"):
        jobs = folder / f"{images}-jobs.json"
        _python(
            str(DATA / "vision" / "make_inputs.py"), "inputs", str(DATA / "vision" / images / "truth.json"), str(jobs)
        )
        out[f"vision {images}"] = _answers("benchmarks.vision", jobs, folder / f"{images}.json")
    return out


def ranges(folder: Path) -> dict[str, Any]:
    """Return the labels and surfaces of the synthetic and the real development scenes."""
    out: dict[str, Any] = {}
    for scenes in ("synthetic", "real"):
        answers = folder / f"range-{scenes}"
        _python("-m", "benchmarks.range", str(DATA / "range" / scenes), str(answers))
        out |= {f"range {scenes} {path.stem}": _content(path) for path in sorted(answers.rglob("*.*"))}
    return out


SUBJECTS = {"missions": missions, "fusion": fusion, "pose": pose, "vision": vision, "range": ranges}


def _answers(module: str, cases: Path, out: Path) -> Any:
    _python("-m", module, str(cases), str(out))
    return json.loads(out.read_text(encoding="utf-8"))


def _content(path: Path) -> Any:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return {name: hashlib.sha256(np.ascontiguousarray(arrays[name]).tobytes()).hexdigest() for name in arrays}
    return json.loads(path.read_text(encoding="utf-8"))


def _python(*arguments: str) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, *arguments], cwd=ROOT, env=environment, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())
