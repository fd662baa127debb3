"""Tests of `panelwright inspect`, `set` and `panel`, of the address in the environment, and of tab completion."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hal.errors import ConfigError, InvalidRequest
from hal.panel import Panel, load_panel
from service.cli import _app
from service.commands.objects import body_of
from service.serve import Panelwright

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def panel() -> Panel:
    return load_panel(ROOT / "panels/bench.toml")


def test_a_target_is_given_in_the_terms_of_the_object(panel: Panel) -> None:
    assert body_of(panel.object("main_valve"), "open") == {"state": "open"}
    assert body_of(panel.object("setpoint"), "30") == {"value": 30.0}
    assert body_of(panel.object("bypass"), "90") == {"angle_rad": pytest.approx(math.pi / 2)}
    assert body_of(panel.object("start"), None) == {"state": "on"}


@pytest.mark.parametrize(
    ("name", "target", "hint"),
    [
        ("main_valve", "ajar", "give one of: "),
        ("main_valve", None, "give one of: "),
        ("setpoint", "130", "give 0 to 100 %"),
        ("setpoint", "nan", "give 0 to 100 %"),
        ("bypass", "far", "give -360 to 360°"),
        ("pressure", "3", "choose another object"),
    ],
)
def test_what_cannot_be_a_target_is_refused_with_what_can(
    panel: Panel, name: str, target: str | None, hint: str
) -> None:
    with pytest.raises(InvalidRequest) as refused:
        body_of(panel.object(name), target)
    assert refused.value.hint.startswith(hint)


def test_a_panel_file_is_checked_and_listed(tmp_path: Path) -> None:
    done = CliRunner().invoke(_app(), ["panel", "check", str(ROOT / "panels/bench.toml")])
    assert (done.exit_code, "describes panel bench: 14 objects" in done.output) == (0, True)
    listed = CliRunner().invoke(_app(), ["panel", "list", str(ROOT / "panels/bench.toml")], env={"COLUMNS": "200"})
    assert "setpoint" in listed.output and "0 to 100 %" in listed.output
    wrong = tmp_path / "panel.toml"
    wrong.write_text('schema = 1\nname = "x"\nwidth_m = -1\nheight_m = 0.4\n')
    refused = CliRunner().invoke(_app(), ["panel", "check", str(wrong)])
    assert isinstance(refused.exception, ConfigError) and "width_m" in refused.exception.what


def test_the_address_of_the_service_comes_from_the_environment(served: Panelwright) -> None:
    done = CliRunner().invoke(_app(), ["set", "nothing", "on"], env={"PANELWRIGHT_URL": served.url})
    assert isinstance(done.exception, InvalidRequest)
    assert done.exception.hint == "its objects: pump_lamp"
    done = CliRunner().invoke(_app(), ["inspect", "nothing"], env={"PANELWRIGHT_URL": served.url})
    assert isinstance(done.exception, InvalidRequest)


def test_nothing_moves_without_a_yes(served: Panelwright, monkeypatch: pytest.MonkeyPatch, panel: Panel) -> None:
    monkeypatch.setattr("service.commands.objects._panel", lambda _client: panel)
    before = len(served.service.tasks.all())
    done = CliRunner().invoke(_app(), ["set", "main_valve", "open", "--url", served.url], input="n\n")
    assert done.exit_code == 1 and "works it to open. Is the cell clear?" in done.output
    assert len(served.service.tasks.all()) == before


def test_the_shell_completes_commands() -> None:
    import os

    env = {"_PANELWRIGHT_COMPLETE": "complete_bash", "COMP_WORDS": "panelwright insp", "COMP_CWORD": "1"}
    done = CliRunner().invoke(_app(), [], env={**os.environ, **env}, prog_name="panelwright")
    assert done.output.split() == ["inspect"]
