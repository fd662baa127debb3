"""A sweep runs real servers: ten random panels with one deed each, and the same panels on workers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hal.config import load_cell
from hal.errors import InvalidRequest
from service.cli import _app
from service.sweep.ask import PanelRun
from service.sweep.options import SweepOptions, chosen
from service.sweep.run import run_panel
from service.sweep.sweep import hash_of, sweep

BENCH = Path(__file__).parents[3] / "cells/bench.toml"
TEN = dict(
    zip(range(7001, 7011), 2 * ("slider", "toggle", "rotary", "mushroom", "button with lamp"), strict=True)
)  # kinds whose deeds take seconds


def options(only: str, *, inline: bool) -> SweepOptions:
    return SweepOptions(cell=BENCH, only=(only,), known_pose=True, inline=inline)


@pytest.fixture(scope="module")
def ten() -> list[PanelRun]:
    return [run_panel(seed, options(only, inline=True)) for seed, only in TEN.items()]


@pytest.mark.slow
@pytest.mark.timeout(900)  # 45 s of a quiet machine, shared with three other files
def test_ten_random_panels_say_nothing_that_is_not_so(ten: list[PanelRun]) -> None:
    assert [run.problem for run in ten] == [""] * 10
    deeds = [deed for run in ten for deed in run.deeds]
    assert len(deeds) == 10
    assert [deed.line() for deed in deeds if deed.is_untrue] == []
    wrong = [deed.line() for deed in deeds if not deed.is_right]
    assert len(wrong) <= 1, wrong


@pytest.mark.slow
def test_a_panel_repeats_in_other_processes_to_the_last_bit(ten: list[PanelRun]) -> None:
    told: list[int] = []
    (again,) = sweep([7002], options("toggle", inline=False), workers=2, progress=lambda run: told.append(run.seed))
    assert told == [7002]
    first = run_panel(7002, options("toggle", inline=False))
    assert replace(again, wall_s=0.0) == replace(first, wall_s=0.0) and hash_of(again) == hash_of(first)
    (inline,), (apart,) = ten[1].deeds, again.deeds
    assert inline.peak_n == pytest.approx(apart.peak_n, rel=1e-7)
    assert inline.impulse_n_s == pytest.approx(apart.impulse_n_s, rel=1e-7)


def test_an_unknown_control_is_refused_with_the_nearest_one() -> None:
    assert chosen("slider, wheel 720") == ("slider", "wheel 720")
    with pytest.raises(InvalidRequest) as refused:
        chosen("sliders")
    assert "slider" in refused.value.hint


def test_the_files_of_a_seed_can_be_written_for_other_commands(tmp_path: Path) -> None:
    words = ["sweep", "--first", "5", "--panels", "2", "--draw", str(tmp_path)]
    result = CliRunner().invoke(_app(), words)
    assert result.exit_code == 0, result.output
    assert load_cell(tmp_path / "6" / "cell.toml").panel.name == "random_6"
