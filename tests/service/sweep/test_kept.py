"""A sweep that is interrupted, or loses a worker, goes on and loses no panel; its results are Parquet, too."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import duckdb
import pytest

import service.sweep.sweep as sweeping
from hal.errors import ConfigError
from service.sweep.ask import PanelRun
from service.sweep.kept import Kept, seeds_of
from service.sweep.options import SweepOptions
from service.sweep.parquet import summary_of, write_parquet
from tests.service.sweep.broken_worker import DIES, run_or_die
from tests.service.sweep.test_table import RUNS


@pytest.fixture
def options(tmp_path: Path) -> SweepOptions:
    cell = tmp_path / "cell.toml"
    cell.write_text("schema = 1\n", encoding="utf-8")
    return SweepOptions(cell=cell)


def test_finished_panels_are_kept_whole_and_not_run_again(
    options: SweepOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def run_panel(seed: int, _options: SweepOptions) -> PanelRun:
        asked.append(seed)
        if seed == 6 and asked.count(6) == 1:
            raise KeyboardInterrupt
        return next(run for run in RUNS if run.seed == seed)

    monkeypatch.setattr(sweeping, "run_panel", run_panel)
    with pytest.raises(KeyboardInterrupt):
        sweeping.sweep([4, 5, 6, 7], options, kept=Kept(tmp_path / "out", options))
    told: list[int] = []
    runs = sweeping.sweep(
        [4, 5, 6, 7], options, kept=Kept(tmp_path / "out", options), progress=lambda run: told.append(run.seed)
    )
    assert runs == RUNS
    assert (asked, told) == ([4, 5, 6, 6, 7], [4, 5, 6, 7])
    sweeping.sweep([4, 5, 6, 7], options, kept=Kept(tmp_path / "out", options))
    assert asked[5:] == [7], "a panel that could not run is tried again"


def test_a_damaged_panel_is_run_again_and_another_sweep_is_refused(options: SweepOptions, tmp_path: Path) -> None:
    kept = Kept(tmp_path / "out", options)
    kept.keep(RUNS[0])
    assert kept.run_of(4) == RUNS[0]
    (tmp_path / "out/panels/4.json").write_text('{"seed": 4', encoding="utf-8")
    assert kept.run_of(4) is None
    with pytest.raises(ConfigError, match="other options"):
        Kept(tmp_path / "out", replace(options, mission=True))
    options.cell.write_text("schema = 1\n# changed\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="another state of its cell file"):
        Kept(tmp_path / "out", options)


@pytest.mark.timeout(300)
def test_a_worker_that_is_killed_loses_no_panel(
    options: SweepOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dies = tmp_path / "dies"
    dies.touch()
    monkeypatch.setenv(DIES, str(dies))
    monkeypatch.setattr(sweeping, "run_panel", run_or_die)
    kept = Kept(tmp_path / "out", options)
    runs = sweeping.sweep([1, 2, 3, 4], options, workers=2, kept=kept)
    assert not dies.exists(), "a worker was killed"
    assert [run.seed for run in runs] == [1, 2, 3, 4]
    assert [kept.run_of(seed) for seed in (1, 2, 3, 4)] == runs


@pytest.mark.parametrize(
    ("text", "wanted"), [("1-4", [1, 2, 3, 4]), ("7", [7]), ("1-2, 40,2", [1, 2, 40]), ("3-3", [3])]
)
def test_seeds_are_ranges_and_single_ones(text: str, wanted: list[int]) -> None:
    assert seeds_of(text) == wanted


@pytest.mark.parametrize("text", ["", "a", "5-1", "1-", "-4", "1-2-3"])
def test_what_is_no_list_of_seeds_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="no list of seeds"):
        seeds_of(text)


def test_the_parquet_files_have_every_deed_and_wilsons_bounds(tmp_path: Path) -> None:
    deeds, summary = write_parquet(RUNS, tmp_path / "out")
    rows = duckdb.execute(f"SELECT seed, verdict, peak_n FROM '{deeds}' ORDER BY seed, verdict").fetchall()  # noqa: S608 - our own file
    assert [row[0] for row in rows] == [4, 5, 5, 6]
    (slider,) = duckdb.execute(f"SELECT * FROM '{summary}' WHERE control = 'slider'").fetchall()  # noqa: S608 - our own file
    assert slider[:3] == ("slider", 4, 1)
    assert slider[3] == pytest.approx(0.0456, abs=1e-3)
    assert [row["control"] for row in summary_of(RUNS)] == ["slider", "all"]
    write_parquet([], tmp_path / "out")
    assert duckdb.execute(f"SELECT COUNT(*) FROM '{deeds}'").fetchall() == [(0,)]  # noqa: S608 - our own file
    assert (
        json.dumps(sorted(path.name for path in (tmp_path / "out").iterdir())) == '["deeds.parquet", "summary.parquet"]'
    )
