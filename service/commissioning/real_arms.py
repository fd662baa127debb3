"""Sections of a new real cell that depend on its arm, taken from the shipped real cell of that arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import tomlkit
from tomlkit import TOMLDocument

from service.terminal import ROOT

ArmName = Literal["ur10e", "cia402", "dynamixel", "ros2"]
GUESSED = ("panel_position_m", "panel_rpy_rad", "park_rad", "floor_z_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class RealArm:
    """What `panelwright init --cell` knows of an arm.

    Attributes:
        shipped: its example in `cells/`.
        address: option of the arm, and of a gripper on the same link, that says where it is.
        usual_address: what is written unless it is given.
        shares_link: the gripper is on the link of the arm.
        has_own_kinematics: the cell file states the kinematics, which in the example are those of some other arm.
        note: what the cell file says above the arm.
    """

    shipped: str
    address: str
    usual_address: str
    shares_link: bool
    has_own_kinematics: bool = True
    note: str

    def document(self) -> TOMLDocument:
        """Return the shipped example."""
        return tomlkit.parse((ROOT / "cells" / self.shipped).read_text(encoding="utf-8"))

    def sections(self, *, address: str, gripper_port: str) -> str:
        """Return the text of the sections of arm and gripper with the given addresses."""
        document = self.document()
        devices: Any = document["devices"]
        for key in [key for key in devices if key not in ("arm", "gripper")]:
            devices.remove(key)
        devices["arm"]["options"][self.address] = address
        is_shared = self.shares_link
        devices["gripper"]["options"][self.address if is_shared else "port"] = address if is_shared else gripper_port
        return f"{self.note}\n{_only(document, 'devices')}\n"

    @property
    def rate_hz(self) -> float:
        """Rate of the control loop."""
        cell: Any = self.document()["cell"]
        return float(cell["control_rate_hz"])

    @property
    def workspace(self) -> str:
        """Return `[workspace]` with a list of what is to be measured."""
        document = self.document()
        table: Any = document["workspace"]
        table["to_measure"] = [*GUESSED, *(["kinematics"] if self.has_own_kinematics else [])]
        return _only(document, "workspace").partition("\n\n")[0]  # what follows is said of the next table


def _only(document: TOMLDocument, table: str) -> str:
    """Return the text of one table of a document, without the comments at the document's head."""
    for key in [key for key in document if key != table]:
        document.remove(key)
    text = tomlkit.dumps(document)
    return text[text.index("\n[") :].strip()


ARMS: Mapping[ArmName, RealArm] = MappingProxyType(
    {
        "ur10e": RealArm(
            shipped="real-ur10e.toml",
            address="host",
            usual_address="192.168.0.10",
            shares_link=False,
            has_own_kinematics=False,
            note="",
        ),
        "cia402": RealArm(
            shipped="real-cia402.toml",
            address="channel",
            usual_address="can0",
            shares_link=False,
            note="# An arm of six CiA-402 drives on CANopen. The kinematics are an example: put in those of the arm.",
        ),
        "dynamixel": RealArm(
            shipped="real-dynamixel.toml",
            address="port",
            usual_address="/dev/serial/by-id/usb-servos",
            shares_link=True,
            note="# An arm of six Dynamixel servos with a seventh as gripper. The kinematics are an example: put in the arm's.",
        ),
        "ros2": RealArm(
            shipped="real-ros2.toml",
            address="host",
            usual_address="192.168.0.10",
            shares_link=True,
            note="# Arm and gripper of a ROS 2 system over rosbridge. Names and kinematics are those of a UR10e: put in the arm's.",
        ),
    }
)
