"""The conformance tests run on any cell and report their results and what could not be tested."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators import tfmini
from drivers.emulators.scripted import ScriptedProximity
from hal.config import load_cell
from hal.errors import ConfigError
from service.commissioning.conform import run
from service.commissioning.conform_report import Notebook
from service.commissioning.driver_records import DriverRecord, parse_record
from tests.service.conftest import WriteCell

ROOT = Path(__file__).parents[3]


def conform(path: Path, report: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], dict[str, Any], str]:
    """Run the command; return its outcome and both reports."""
    command = ["conform", str(path), "--report", str(report), *arguments]
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", *command], capture_output=True, text=True, timeout=240, check=False
    )
    assert f"{report}.md" in done.stdout, done.stdout + done.stderr
    return done, json.loads(Path(f"{report}.json").read_text()), Path(f"{report}.md").read_text()


def test_the_kit_runs_on_a_cell_file_and_reports_what_was_not_tried(write_cell: WriteCell, tmp_path: Path) -> None:
    chosen = ("--device", "finger_proximity", "--level", "connect")
    done, found, text = conform(write_cell(), tmp_path / "reports" / "fake", *chosen)
    assert done.returncode == 0
    assert "test_close_twice_is_once PASSED" in done.stdout
    assert list(found["devices"]) == ["finger_proximity"]
    outcomes = {p["promise"]: (p["outcome"], p["why"]) for p in found["devices"]["finger_proximity"]["promises"]}
    assert outcomes["close twice is once"] == ("passed", "")
    assert outcomes["later samples have later stamps and numbers"] == ("not tried", "level read was not requested")
    assert "| later samples have later stamps and numbers | read | not tried |" in text


def test_without_pytest_the_kit_says_what_to_install(
    write_cell: WriteCell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cell = load_cell(write_cell())
    monkeypatch.setitem(sys.modules, "pytest", None)
    with pytest.raises(ConfigError, match="needs pytest") as refused:
        run(cell, devices=(), level="static", report=tmp_path / "report")
    assert "panelwright[conform]" in refused.value.hint


def test_the_kit_finds_a_broken_promise(write_cell: WriteCell, tmp_path: Path) -> None:
    path = write_cell(options={"panel_lights": {"immortal": True}, "finger_proximity": {"fail": "no answer"}})
    chosen = ("--device", "panel_lights", "--device", "finger_proximity", "--level", "connect")
    done, found, text = conform(path, tmp_path / "fake", *chosen)
    assert done.returncode == 1
    assert "test_after_close_every_read_says_unavailable FAILED" in done.stdout
    lights = {p["promise"]: p for p in found["devices"]["panel_lights"]["promises"]}
    assert lights["after close every read says unavailable"]["outcome"] == "failed"
    assert "DID NOT RAISE" in lights["after close every read says unavailable"]["why"]
    absent = found["devices"]["finger_proximity"]["promises"]
    assert {p["outcome"] for p in absent if p["outcome"] != "not tried"} == {"failed"}
    assert all("no answer" in p["why"] for p in absent if p["outcome"] == "failed")
    assert "did not connect" in text
    assert found["counts"]["failed"] > 1


def test_what_ctrl_c_came_before_is_not_tried_and_said_so(tmp_path: Path) -> None:
    stopped = "raise KeyboardInterrupt"
    tests = "".join(
        f"    def test_{name}(self): {body}\n" for name, body in (("a", "pass"), ("b", stopped), ("c", "pass"))
    )
    (tmp_path / "test_kit.py").write_text(f"class Test_lights:\n{tests}")
    notebook = Notebook("read")
    pytest.main([str(tmp_path), "-p", "no:cacheprovider", "-c", "/dev/null"], plugins=[notebook])
    assert notebook.is_stopped
    assert {f.promise: f.outcome for f in notebook.findings} == {"a": "passed", "b": "not tried", "c": "not tried"}


def test_the_wire_of_an_emulated_device_is_broken_too(tmp_path: Path) -> None:
    chosen = ("--device", "proximity_left", "--record", str(tmp_path))
    done, found, text = conform(ROOT / "cells" / "mixed.toml", tmp_path / "mixed", *chosen)
    device = found["devices"]["proximity_left"]
    assert done.returncode == 0, done.stdout[-3000:]
    assert device["counts"] == {"passed": len(device["promises"])}, "the emulator vanishes and falls silent on demand"
    assert device["link"].startswith("serial ")
    assert "| proximity_left | proximity | serial:tfmini | emulator tfmini |" in text
    record = record_in(tmp_path)
    assert record.conformance is not None and record.conformance.passed == len(device["promises"])
    assert record.hardware == (), "an emulator is no hardware"


def test_a_real_device_that_cannot_be_broken_is_skipped_with_the_reason(write_cell: WriteCell, tmp_path: Path) -> None:
    far_side = tfmini.start(ScriptedProximity(), {})
    try:
        port = far_side.address["port"]
        extra = f'[devices.left]\nkind = "proximity"\ndriver = "serial:tfmini"\noptions = {{ port = "{port}" }}\n'
        path = write_cell(mode="real", extra=extra)
        _, found, _ = conform(path, tmp_path / "real", "--device", "left", "--record", str(tmp_path))
    finally:
        far_side.close()
    skipped = {p["promise"]: p["why"] for p in found["devices"]["left"]["promises"] if p["outcome"] == "skipped"}
    assert skipped["silence is a timeout and in time"] == "this rig cannot make a device silent"
    (report,) = record_in(tmp_path).hardware
    assert (report.cell, report.level, report.conformance.is_good) == ("cell.toml", "read", True)
    assert port in report.link and report.conformance.skipped == len(skipped)


def record_in(folder: Path) -> DriverRecord:
    """Return the record of the TFmini-Plus in a folder."""
    return parse_record((folder / "serial-tfmini.json").read_text(), source="record")
