"""An invalid cell file is refused with all its faults at once, each with key, value and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from hal.config import Cell, load_cell
from hal.devices import Arm, Camera, Device, DeviceKind
from hal.errors import ConfigError
from hal.registry import Context, device_factory, installed_drivers, kinds_of, options_model
from service.commissioning.cell_check import check_cell, objects_in_reach, unit_faults
from service.commissioning.doctor import examine
from service.processes.stop_host import bound_socket
from service.terminal import console
from tests.service.conftest import WriteCell

ROOT = Path(__file__).parents[3]
BENCH = (ROOT / "cells/bench.toml").read_text()
SHIPPED = sorted((ROOT / "cells").glob("*.toml"))

Change = tuple[str, str]


def changed(folder: Path, *changes: Change) -> Path:
    """Return the bench's cell file with parts of its text replaced."""
    text = BENCH.replace("panels/", f"{ROOT}/panels/").replace("cells/", f"{ROOT}/cells/")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "cell.toml"
    path.write_text(text)
    return path


def refused(path: Path) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        check_cell(load_cell(path))
    return caught.value


NO_ARM = ('[devices.arm]\nkind = "arm"\ndriver = "sim:arm"\noptions = { model = "t3" }\n', "")
WRONG_KIND = ('driver = "sim:gripper"', 'driver = "sim:camera"')
NO_MOUNT = ('mount = { parent = "flange", calibration = "wrist_camera" }\n', "")
UNKNOWN_OPTION = ("width = 128,", "widht = 128,")
DEGREES = ("park_rad = [0.0, 1.0472, -1.0472, 0.0, 1.5708, 1.5708]", "park_rad = [0, 60, -60, 0, 90, 90]")
MILLIMETRES = ("panel_position_m = [0.97, 0.0, 0.55]", "panel_position_m = [970, 0, 550]")
FAR_AWAY = ("panel_position_m = [0.97, 0.0, 0.55]", "panel_position_m = [3.0, 0.0, 0.55]")

GOLDEN = {
    "no arm": (
        NO_ARM,
        "devices: the cell has no arm",
        'add [devices.arm] with kind = "arm" and its driver; `panelwright doctor` lists them',
    ),
    "wrong kind": (
        WRONG_KIND,
        "devices.gripper.driver: 'sim:camera' is a camera, and kind is gripper",
        'give a driver of kind gripper (`panelwright doctor` lists them), or write kind = "camera"',
    ),
    "no mount": (
        NO_MOUNT,
        "devices.wrist_camera.mount: is missing, so the pose of the camera is not known",
        'add mount = { parent = "flange", calibration = "wrist_camera" } and that calibration record',
    ),
    "unknown option": (
        UNKNOWN_OPTION,
        "devices.range_scanner.options.widht: unknown key 'widht'",
        "did you mean 'width'?",
    ),
    "degrees": (
        DEGREES,
        "workspace.park_rad: [0.0, 60.0, -60.0, 0.0, 90.0, 90.0] is more than a full turn",
        "if these are degrees, write 0, 1.047, -1.047, 0, 1.571, 1.571 rad",
    ),
    "millimetres": (
        MILLIMETRES,
        "workspace.panel_position_m: [970.0, 0.0, 550.0] is larger than a cell",
        "if these are millimetres, write 0.97, 0, 0.55 m",
    ),
    "out of reach": (
        FAR_AWAY,
        "workspace.panel_position_m: [3.0, 0.0, 0.55] is 3.05 m from the arm's foot, and the arm reaches none of the "
        "panel's objects there",
        "give the place of the panel's middle in the base frame, and panel_rpy_rad so that its z axis points to the arm",
    ),
}


@pytest.mark.parametrize("case", GOLDEN)
def test_what_cannot_be_meant_is_refused_with_key_value_and_remedy(tmp_path: Path, case: str) -> None:
    change, says, remedy = GOLDEN[case]
    path = changed(tmp_path, change)
    error = refused(path)
    assert error.details["faults"] == [f"{says}; {remedy}"]
    assert (error.what, error.hint) == (f"{path}: {says}", remedy)


def test_all_faults_of_a_file_are_told_at_once(tmp_path: Path) -> None:
    path = changed(tmp_path, WRONG_KIND, NO_MOUNT, UNKNOWN_OPTION, DEGREES, MILLIMETRES)
    error = refused(path)
    assert error.what.endswith("(and 4 more faults)")
    told = {
        "; ".join(GOLDEN[case][1:]) for case in ("wrong kind", "no mount", "unknown option", "degrees", "millimetres")
    }
    assert set(error.details["faults"]) == told


def test_the_doctor_does_not_call_such_a_file_in_order_and_connects_nothing(tmp_path: Path) -> None:
    path = changed(tmp_path, UNKNOWN_OPTION, NO_MOUNT)
    with console.capture() as seen:
        assert not examine(path, 1, connect=False)
    told = " ".join(seen.get().split())
    assert "wrong cell file" in told
    assert "did you mean 'width'?" in told and "devices.wrist_camera.mount: is missing" in told


ABSENT = """
[devices.{name}]
kind = "lights"
driver = "modbus:lights"
options = {{ port = "/dev/serial/by-id/{name}", unit = {unit} }}
"""


def test_the_doctor_examines_every_device_although_serial_ones_are_broken(
    write_cell: WriteCell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    extra = "".join(ABSENT.format(name=name, unit=k) for k, name in enumerate(("near_lights", "far_lights"), 1))
    path = write_cell(robot=True, options={"panel_lights": {"fail": "no answer"}}, extra=extra)
    with bound_socket("127.0.0.1", 0) as free:
        port = free.getsockname()[1]
    with console.capture() as seen:
        assert not examine(path, port, connect=True)
    told = " ".join(seen.get().split())
    for name in ("near_lights", "far_lights"):
        assert f"wrong {name} /dev/serial/by-id/{name} does not exist" in told
    assert "wrong panel_lights" in told
    assert "good arm read in" in told and "good finger_touch read in" in told


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_cells_are_in_order_and_their_arm_reaches_the_whole_panel(path: Path) -> None:
    cell = load_cell(path)
    check_cell(cell)
    reached = objects_in_reach(cell)
    assert reached is not None and all(reached.values()) and len(reached) == len(cell.panel.objects)


@pytest.mark.parametrize("driver", installed_drivers())
def test_each_driver_declares_its_options_and_the_device_kind_that_it_drives(driver: str) -> None:
    factory = device_factory(driver)
    assert options_model(factory) is not None
    kinds = kinds_of(factory)
    assert kinds is not None and len(kinds) == 1


def test_a_driver_that_declares_neither_is_believed() -> None:
    def vague(context: Context, options: dict[str, object]) -> Device:
        raise NotImplementedError

    def either(context: Context, options: dict[str, object]) -> Arm | Camera:
        raise NotImplementedError

    assert kinds_of(vague) is None
    assert kinds_of(either) is None


def test_joint_limits_of_several_turns_are_no_degrees_and_nested_lengths_are_looked_at() -> None:
    assert unit_faults({"kinematics": {"lower_rad": [-9.0], "upper_rad": [9.0]}}) == []
    (fault,) = unit_faults({"cables": [{"radius_m": 0.003}, {"path_m": [[0.0, 0.0, 0.0], [300.0, 0.0, 0.0]]}]})
    assert fault.key == "cables.1.path_m"


def test_options_that_an_emulator_fills_in_are_not_missed() -> None:
    cell: Cell = load_cell(ROOT / "cells/wire-ur.toml")
    emulated = next(iter(cell.file.emulators))
    section = cell.file.devices[emulated]
    model = options_model(device_factory(section.driver))
    assert model is not None
    with pytest.raises(ValidationError):
        model.model_validate(section.options)
    check_cell(cell)
    assert cell.names_of(DeviceKind.ARM)
