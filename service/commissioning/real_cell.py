"""Writes the files of a real cell from a few answers: cell file, panel file, and calibration records to be measured.

Everything that nobody has measured yet is a guess with a wide sigma, and its file lists it under `to_measure`;
`panelwright doctor` repeats the list until it is empty.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hal.errors import ConfigError, InvalidRequest
from hal.toml_text import toml_text
from service.commissioning.real_arms import ARMS, ArmName

FindBy = Literal["lights", "tags", "outline"]
TAG_M, CORNER_M = 0.040, 0.040  # side of a tag, and distance of lights and tags from the plate's edges
WIDE_SIGMA = {"sigma_m": [0.01, 0.01, 0.01], "sigma_rad": [0.05, 0.05, 0.05]}
CORNERS = {"upper_left": (-1, 1), "upper_right": (1, 1), "lower_right": (1, -1), "lower_left": (-1, -1)}
CAMERA_PX = (1280, 720)


@dataclass(frozen=True, slots=True, kw_only=True)
class RealCell:
    """The answers that describe a real cell.

    Attributes:
        arm: one of `ARMS`.
        name: of the cell and its files.
        arm_address: host name or address of the arm's controller, its CAN channel or its serial port.
        gripper_port, wrench_port: serial ports by a stable name; no wrench sensor if that is empty. A gripper on the
            link of the arm needs no port.
        camera, camera_device: driver of the camera, and what that driver opens.
        io_address: host of the Modbus I/O that switches the lights; no lights if it is empty.
        find_by: what shows where the panel is.
        plate_m: width and height of the panel's plate.
    """

    arm: ArmName = "ur10e"
    name: str = "real_ur10e"
    arm_address: str = "192.168.0.10"
    gripper_port: str = "/dev/serial/by-id/usb-gripper"
    camera: str = "v4l2:camera"
    camera_device: str = "/dev/v4l/by-id/usb-camera-video-index0"
    wrench_port: str = "/dev/serial/by-id/usb-wrench"
    io_address: str = "192.168.0.20"
    find_by: FindBy = "lights"
    plate_m: tuple[float, float] = (0.62, 0.46)

    @classmethod
    def usual(cls, arm: ArmName) -> RealCell:
        """Return the usual answers for an arm."""
        return cls(arm=arm, name=f"real_{arm}", arm_address=ARMS[arm].usual_address)

    def __post_init__(self) -> None:
        if self.find_by == "lights" and not self.io_address:
            raise InvalidRequest(
                "border lights need an I/O that switches them", hint="give --io-address, or --find-by tags or outline"
            )


def write_real_cell(cell: RealCell, folder: Path) -> tuple[Path, ...]:
    """Write all files of a cell below a folder and return their paths, the cell file first; all files or none.

    Raises:
        ConfigError: a file exists already.
    """
    files = texts_of(cell)
    taken = [folder / path for path in files if (folder / path).exists()]
    if taken:
        raise ConfigError(
            f"{taken[0]} exists already; nothing was written", hint="give another folder or --name, or move it away"
        )
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    return tuple(folder / path for path in files)


def texts_of(cell: RealCell, *, today: Callable[[], str] = lambda: time.strftime("%Y-%m-%d")) -> dict[Path, str]:
    """Return the text of every file by its path, the cell file first."""
    stem = cell.name.replace("_", "-")
    records = _records(cell)
    return {
        Path("cells") / f"{stem}.toml": _cell_text(cell, stem),
        Path("panels") / f"{stem}.toml": toml_text(_panel(cell), remarks=PANEL_REMARKS),
        **{
            Path("cells") / stem / f"{device}.toml": toml_text(
                {"schema": 1, "device": device, "version": 1, "date": today(), **record}, remarks=RECORD_REMARKS
            )
            for device, record in records.items()
        },
    }


PANEL_REMARKS = (
    "The panel before the arm. Origin in the middle of the plate's front face, x right, y up, z towards the viewer; metres.",
    "Measure what `to_measure` names, correct it here, and take the name off the list. The button is an example: teach the",
    "panel's own objects (docs/tutorials/first-real-cell.md).",
)
RECORD_REMARKS = (
    "Nobody has measured what `to_measure` names: it is a guess. A calibration takes the name off the list.",
)


def _panel(cell: RealCell) -> dict[str, Any]:
    width, height = cell.plate_m
    x, y = width / 2 - CORNER_M, height / 2 - CORNER_M
    panel: dict[str, Any] = {
        "schema": 1,
        "name": cell.name,
        "width_m": width,
        "height_m": height,
        "thickness_m": 0.003,
        "to_measure": ["width_m", "height_m", *([cell.find_by] if cell.find_by != "outline" else []), "objects"],
        "tolerances": {"edge_m": 0.0005, "light_m": 0.0003, "tag_m": 0.0005, "position_m": 0.0005},
    }
    places = {name: (round(right * x, 4), round(up * y, 4)) for name, (right, up) in CORNERS.items()}
    if cell.find_by == "lights":
        panel["lights"] = [
            {"name": f"light_{name}", "position_m": [*place, 0.0], "radius_m": 0.008} for name, place in places.items()
        ]
    if cell.find_by == "tags":
        panel["tags"] = [
            {"id": k, "family": "36h11", "size_m": TAG_M, "position_m": [*place, 0.0]}
            for k, place in enumerate(places.values())
        ]
    panel["objects"] = [
        {"kind": "button", "name": "start", "label": "START", "position_m": [0.0, 0.0], "radius_m": 0.013}
    ]
    return panel


def _records(cell: RealCell) -> dict[str, Mapping[str, Any]]:
    """Return the calibration record of every mounted device, without its head."""
    guessed = "not measured: from drawings and data sheets"
    width, height = CAMERA_PX
    records: dict[str, Mapping[str, Any]] = {
        "gripper": {
            "method": guessed,
            "to_measure": ["mount"],
            "mount": {"position_m": [0.0, 0.0, 0.21], "rpy_rad": [0.0, 0.0, 0.0], **WIDE_SIGMA},
        },
        "wrist_camera": {
            "method": guessed,
            "to_measure": ["mount", "intrinsics"],
            "mount": {"position_m": [0.0, -0.09, 0.06], "rpy_rad": [0.0, 0.0, 0.0], **WIDE_SIGMA},
            "intrinsics": {
                "width_px": width,
                "height_px": height,
                "fx_px": float(width),
                "fy_px": float(width),
                "cx_px": (width - 1) / 2,
                "cy_px": (height - 1) / 2,
                "rms_px": 1.0,
                "sigma_focal_ratio": 0.05,
                "sigma_centre_px": 20.0,
                "sigma_k1": 0.1,
            },
        },
    }
    if cell.wrench_port:
        records["wrist_ft"] = {
            "method": guessed,
            "to_measure": ["mount", "load"],
            "mount": {"position_m": [0.0, 0.0, 0.0], "rpy_rad": [0.0, 0.0, 0.0], **WIDE_SIGMA},
            "load": {"mass_kg": 1.1, "centre_of_mass_m": [0.0, 0.0, 0.06]},
        }
    return records


def _cell_text(cell: RealCell, stem: str) -> str:
    arm = ARMS[cell.arm]
    is_ur = cell.arm == "ur10e"
    parts = [
        HEAD.format(name=cell.name, stem=stem, rate_hz=arm.rate_hz),
        *([ARM.format(address=cell.arm_address), GRIPPER.format(port=cell.gripper_port)] if is_ur else []),
        *([] if is_ur else [arm.sections(address=cell.arm_address, gripper_port=cell.gripper_port)]),
        _camera_text(cell),
        WRENCH.format(port=cell.wrench_port) if cell.wrench_port else NO_WRENCH,
        LIGHTS.format(address=cell.io_address) if cell.find_by == "lights" else NO_LIGHTS.format(way=cell.find_by),
        REST.format(workspace=arm.workspace),
    ]
    return "\n".join(parts)


def _camera_text(cell: RealCell) -> str:
    width, height = CAMERA_PX
    key = "device" if cell.camera == "v4l2:camera" else "camera"
    size = f", width_px = {width}, height_px = {height}" if cell.camera == "v4l2:camera" else ""
    return CAMERA.format(driver=cell.camera, options=f'{key} = "{cell.camera_device}"{size}')


HEAD = """\
# A real cell, written by `panelwright init`. What `to_measure` names here, in panels/{stem}.toml and in cells/{stem}/ is a
# guess; `panelwright doctor --no-connect --cell cells/{stem}.toml` lists it. docs/tutorials/first-real-cell.md says how.
schema = 1

[cell]
name = "{name}"
mode = "real"
panel = "panels/{stem}.toml"
calibrations = "cells/{stem}"
control_rate_hz = {rate_hz:.1f}
"""
ARM = """\
# A UR10e in remote control, with the payload set on the pendant. Its kinematics are the nominal ones of that model.
[devices.arm]
kind = "arm"
driver = "ur:rtde"
options = {{ host = "{address}", rate_hz = 500.0, watchdog_s = 0.1 }}
"""
GRIPPER = """\
# A Robotiq 2F-85 on its own RS-485 adapter. The names in /dev/serial/by-id stay when ports are plugged in again.
[devices.gripper]
kind = "gripper"
driver = "modbus:robotiq_2f"
options = {{ port = "{port}", baud = 115200 }}
mount = {{ parent = "flange", calibration = "gripper" }}
"""
CAMERA = """\
# Fix focus and exposure: a lens that focuses by itself has no calibration.
[devices.wrist_camera]
kind = "camera"
driver = "{driver}"
options = {{ {options} }}
mount = {{ parent = "flange", calibration = "wrist_camera" }}
"""
WRENCH = """\
# A Robotiq FT 300 between flange and gripper, streaming at 100 Hz.
[devices.wrist_ft]
kind = "force_torque"
driver = "serial:ft300"
options = {{ port = "{port}" }}
mount = {{ parent = "flange", calibration = "wrist_ft" }}
"""
NO_WRENCH = """\
# No force/torque sensor: locate and read the panel, but run no missions, because nothing limits the force of a touch.
"""
LIGHTS = """\
# Four border lights on outputs 0 to 3 of a Modbus I/O, their feedback on inputs 0 to 3, the emergency stop on input 7.
[devices.panel_lights]
kind = "lights"
driver = "modbus:lights"
options = {{ host = "{address}", port = 502 }}
"""
NO_LIGHTS = """\
# No border lights: the panel is found by its {way}.
"""
REST = """\
# Where the panel stands: its middle in the arm's base frame, within the tolerances. Its z axis points to the arm.
{workspace}

# The first motions run at a tenth of the usual 0.25 m/s. Raise it when the arm goes where it should.
[safety]
force_limit_n = 60.0
speed_limit_m_per_s = 0.025
lease_ttl_s = 2.0
max_reading_age_s = 0.1
"""
