"""The tables of a sweep count every deed once and name the seeds that repeat a failure."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.stats import binomtest

from service.sweep.ask import PanelRun
from service.sweep.judge import JudgedDeed, Verdict
from service.sweep.options import SweepOptions
from service.sweep.sweep import hash_of, write
from service.sweep.table import report, wilson

DEED = JudgedDeed(
    seed=4, object="setpoint", kind="slider", row="slider", goal="40", verdict=Verdict.RIGHT, outcome="done", cause="",
    cause_is_true=None, before="20", after="40", moved_unasked=(), touched_unasked=(), peak_n=12.0, impulse_n_s=3.0,
    chatter_n=0.5, said_peak_n=11.0, attempts=1, cell_s=6.0,
)  # fmt: skip
MISSED = replace(
    DEED, verdict=Verdict.FAILED, outcome="missed", cause="nothing at 12 mm | 3 mm", cause_is_true=True, seed=5
)
FALSE = replace(DEED, verdict=Verdict.FALSE, cause_is_true=False, seed=6, moved_unasked=("pump",), peak_n=120.0)
RUNS = [
    PanelRun(seed=4, deeds=(DEED,), cell_s=6.0),
    PanelRun(seed=5, deeds=(MISSED, replace(MISSED, cause="nothing at 9 mm | 4 mm")), cell_s=6.0),
    PanelRun(seed=6, deeds=(FALSE,), cell_s=6.0),
    PanelRun(seed=7, deeds=(), problem="DeviceUnavailable: no world"),
]


@pytest.mark.parametrize(("successes", "trials"), [(0, 5), (5, 5), (38, 45), (397, 400)])
def test_the_bounds_are_wilsons(successes: int, trials: int) -> None:
    expected = binomtest(successes, trials).proportion_ci(method="wilson")
    assert wilson(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-4)


def test_the_report_counts_verdicts_forces_causes_and_what_moved() -> None:
    text = report(RUNS)
    assert "| slider | 1 of 4 | 4.6 % | 2 | 1 | 0 |" in text
    assert "| slider | typed failure | missed | nothing at 12 mm / 3 mm | 2 | 2 | 5, 5 |" in text
    assert "all deeds right: 1 of 4 panels" in text
    assert "moved unasked: 1 (6 slider: pump)" in text
    assert "above 100 N: 1 (6 slider 120 N)" in text
    assert "seed 7: DeviceUnavailable: no world" in text


def test_the_hash_ignores_the_time_on_the_wall_only() -> None:
    assert hash_of(RUNS[0]) == hash_of(replace(RUNS[0], wall_s=99.0))
    assert hash_of(RUNS[0]) != hash_of(replace(RUNS[0], deeds=(replace(DEED, peak_n=12.5),)))


def test_the_files_hold_every_deed(tmp_path: Path) -> None:
    data, text = write(RUNS, SweepOptions(cell=Path("cells/bench.toml")), tmp_path / "out")
    document = json.loads(data.read_text())
    assert [len(panel["deeds"]) for panel in document["panels"]] == [1, 2, 1, 0]
    assert document["panels"][2]["deeds"][0]["verdict"] == "said done and was not"
    assert text.read_text().startswith("# 4 random panels, seeds 4 to 7, bench.toml")
