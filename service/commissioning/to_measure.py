"""Lists what in a cell's files is still a guess, and how to measure it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from hal.config import Cell
from hal.devices import DeviceKind

WORKSPACE_HOW = {
    "floor_z_m": "a ruler, from the arm's foot",
    "kinematics": "the maker's table of Denavit-Hartenberg parameters, limits and zero positions",
}
PANEL_HOW = {
    "lights": "measure the four lamps' centres from the plate's edges with a caliper",
    "tags": "measure the middle and the side of each black square from the plate's edges with a caliper",
    "objects": "teach them: `panelwright teach panel`, or write [[objects]] (docs/reference/panel-file.md)",
}
HOW = {
    (DeviceKind.CAMERA, "intrinsics"): "`panelwright calibrate camera`, or photographs: `panelwright calibrate board`",
    (DeviceKind.CAMERA, "mount"): "a ruler to 1 cm, then `panelwright calibrate hand-eye`",
    (DeviceKind.RANGE_SCANNER, "mount"): "a ruler to 1 cm, then `panelwright calibrate scanner`",
    (DeviceKind.FORCE_TORQUE, "load"): "`panelwright calibrate tool`",
    (DeviceKind.FORCE_TORQUE, "mount"): "the drawing of the adapter: sensor axes in the flange frame",
    (DeviceKind.GRIPPER, "mount"): "touch one point from four sides, then `panelwright calibrate tip`",
    (DeviceKind.PROXIMITY, "mount"): "a ruler, then `panelwright calibrate zero` with gauge blocks",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ToMeasure:
    """A guessed value: the file and key, and how to measure it."""

    where: str
    what: str
    how: str


def to_measure(cell: Cell) -> Iterator[ToMeasure]:
    """Yield everything that the files of the cell list as not measured."""
    file = cell.path.name
    for key in cell.file.workspace.to_measure:
        what = "devices.arm.options.kinematics" if key == "kinematics" else f"workspace.{key}"
        yield ToMeasure(where=file, what=what, how=WORKSPACE_HOW.get(key, "jog the arm, read the pendant"))
    for part in cell.panel.to_measure:
        yield ToMeasure(where=cell.file.cell.panel, what=part, how=PANEL_HOW.get(part, "a ruler or a caliper"))
    for device, section in cell.file.devices.items():
        if section.mount is None:
            continue
        for result in cell.calibration_of(device).to_measure:
            how = HOW.get((section.kind, result), "see docs/how-to/calibrate.md")
            yield ToMeasure(where=f"calibration of {device}", what=result, how=how)
