"""A real cell's files are written from answers, pass the checks, and say what nobody has measured yet."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hal.calibration import load_calibration
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import ConfigError, InvalidRequest
from perception.calibration import renewed, to_toml
from service.cli import _app
from service.commissioning.preflight import check_machine
from service.commissioning.real_arms import ARMS, ArmName
from service.commissioning.real_cell import FindBy, RealCell, texts_of, write_real_cell
from service.commissioning.to_measure import to_measure
from service.terminal import ROOT
from tests.docs.blocks import blocks


def test_the_shipped_cell_is_what_the_usual_answers_write() -> None:
    texts = texts_of(RealCell(), today=lambda: "2026-11-23")
    assert {path: (ROOT / path).read_text(encoding="utf-8") for path in texts} == texts


@pytest.mark.parametrize("find_by", ["lights", "tags", "outline"])
def test_the_files_of_every_answer_pass_the_checks(find_by: FindBy, tmp_path: Path) -> None:
    io = "192.168.0.20" if find_by == "lights" else ""
    cell = load_cell(write_real_cell(RealCell(find_by=find_by, io_address=io, wrench_port=""), tmp_path)[0])
    check_machine(cell)
    assert bool(cell.names_of(DeviceKind.LIGHTS)) == (find_by == "lights")
    assert not cell.names_of(DeviceKind.FORCE_TORQUE)
    assert {guess.what for guess in to_measure(cell)} >= {"width_m", "objects", "mount", "workspace.park_rad"}
    assert (find_by in cell.panel.to_measure) == (find_by != "outline")


def test_a_cell_of_flags_is_written_and_the_doctor_lists_what_is_to_be_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["--cell", "ur10e", "--name", "hall_3", "--arm-address", "10.0.0.7", "--find-by", "tags", "--no-ask"]
    done = CliRunner().invoke(_app(), ["init", str(tmp_path), *words, "--wrench-port", "-", "--plate", "0.5x0.4"])
    assert done.exit_code == 0, done.output
    cell = load_cell(tmp_path / "cells/hall-3.toml")
    assert cell.file.devices["arm"].options["host"] == "10.0.0.7"
    assert (cell.panel.width_m, len(cell.panel.tags), len(cell.panel.lights)) == (0.5, 4, 0)
    monkeypatch.chdir(tmp_path)
    told = CliRunner().invoke(_app(), ["doctor", "--no-connect", "--cell", "cells/hall-3.toml", "--port", "0"])
    assert told.exit_code == 0, told.output


@pytest.mark.parametrize("arm", ["cia402", "dynamixel", "ros2"])
def test_the_cell_of_another_arm_is_written_with_its_own_driver_and_guesses(arm: ArmName, tmp_path: Path) -> None:
    words = ["--cell", arm, "--name", "hall_4", "--arm-address", "can7", "--no-ask"]
    done = CliRunner().invoke(_app(), ["init", str(tmp_path), *words])
    assert done.exit_code == 0, done.output
    cell, shipped = load_cell(tmp_path / "cells/hall-4.toml"), load_cell(ROOT / "cells" / ARMS[arm].shipped)
    check_machine(cell)
    assert cell.file.devices["arm"].driver == shipped.file.devices["arm"].driver
    assert cell.file.devices["arm"].options[ARMS[arm].address] == "can7"
    is_shared = cell.file.devices["gripper"].options.get(ARMS[arm].address) == "can7"
    assert is_shared == ARMS[arm].shares_link
    assert cell.file.cell.control_rate_hz == shipped.file.cell.control_rate_hz
    assert cell.file.workspace.park_rad == shipped.file.workspace.park_rad
    told = {guess.what for guess in to_measure(cell)}
    assert told >= {"devices.arm.options.kinematics", "workspace.park_rad", "mount", "lights"}


def test_questions_are_asked_one_by_one_and_enter_takes_the_usual_answer(tmp_path: Path) -> None:
    answers = ["10.1.2.3", "", "", "", "-", "", "outline", ""]
    done = CliRunner().invoke(
        _app(), ["init", str(tmp_path), "--cell", "ur10e", "--ask"], input="\n".join(answers) + "\n"
    )
    assert done.exit_code == 0, done.output
    cell = load_cell(tmp_path / "cells/real-ur10e.toml")
    assert cell.file.devices["arm"].options["host"] == "10.1.2.3"
    assert set(cell.file.devices) == {"arm", "gripper", "wrist_camera"}


def test_nothing_is_overwritten_and_lights_need_an_io(tmp_path: Path) -> None:
    write_real_cell(RealCell(), tmp_path)
    with pytest.raises(ConfigError, match="exists already; nothing was written"):
        write_real_cell(RealCell(), tmp_path)
    with pytest.raises(InvalidRequest, match="border lights need an I/O"):
        RealCell(io_address="")


def test_a_calibration_takes_its_parts_off_the_list(tmp_path: Path) -> None:
    guessed = load_calibration(ROOT / "cells/real-ur10e/wrist_camera.toml")
    assert guessed.to_measure == ("mount", "intrinsics")
    lens = guessed.model_copy(update={"mount": None, "method": "intrinsics"})
    after = renewed(guessed, lens)
    assert after.to_measure == ("mount",)
    done = renewed(after, guessed.model_copy(update={"intrinsics": None}))
    path = tmp_path / "record.toml"
    path.write_text(to_toml(done), encoding="utf-8")
    assert load_calibration(path).to_measure == () and "to_measure" not in path.read_text(encoding="utf-8")


def test_the_files_of_the_tutorial_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = [one for one in blocks() if one.page.name == "first-real-cell.md" and "panelwright init" in one.code]
    monkeypatch.chdir(tmp_path)
    for line in block.code.strip().splitlines():
        name, *words = shlex.split(line)
        if name == "cd":
            monkeypatch.chdir(words[0])
            continue
        done = CliRunner().invoke(_app(), [*words, "--port", "0"] if words[0] == "doctor" else words)
        assert done.exit_code == 0, done.output
