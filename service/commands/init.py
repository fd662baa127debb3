"""`panelwright init`: copies a cell with all its files into a folder, or asks about a real cell and writes its files."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from hal.errors import InvalidRequest
from service.commands.common import DEFAULT_CELL, console

if TYPE_CHECKING:
    from service.commissioning.real_arms import ArmName
    from service.commissioning.real_cell import RealCell

ASKED = "Real cells: asked for if not given; "
ARMS = ("ur10e", "cia402", "dynamixel", "ros2")
QUESTIONS = {
    "arm_address": "address of the arm's controller, or its CAN channel or serial port",
    "gripper_port": "serial port of a gripper with a port of its own",
    "camera": "driver of the camera",
    "camera_device": "what that driver opens",
    "wrench_port": "serial port of the force/torque sensor (none: -)",
    "io_address": "address of the Modbus I/O that switches the border lights (none: -)",
    "find_by": "what shows where the panel is: lights, tags or outline",
    "plate": "width and height of the panel's plate, m",
}
FIND_BY = ("lights", "tags", "outline")


app = typer.Typer()


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; created if missing.")],
    *,
    cell: Annotated[
        str, typer.Option("--cell", help=f"Cell file to copy, or the arm of a new real cell: {', '.join(ARMS)}.")
    ] = str(DEFAULT_CELL),
    name: Annotated[str | None, typer.Option(help="Real cells: name of the cell and its files.")] = None,
    arm_address: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["arm_address"] + ".")] = None,
    gripper_port: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["gripper_port"] + ".")] = None,
    camera: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["camera"] + ".")] = None,
    camera_device: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["camera_device"] + ".")] = None,
    wrench_port: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["wrench_port"] + ".")] = None,
    io_address: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["io_address"] + ".")] = None,
    find_by: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["find_by"] + ".")] = None,
    plate: Annotated[str | None, typer.Option(help=ASKED + QUESTIONS["plate"] + ", such as 0.62x0.46.")] = None,
    ask: Annotated[
        bool | None, typer.Option(help="Ask for what is not given; without a terminal the usual values are written.")
    ] = None,
) -> None:
    """Copy a cell with its files into FOLDER for editing, or write the files of a new real cell."""
    if cell not in ARMS:
        _copy(Path(cell), folder)
        return
    given = {
        "arm_address": arm_address,
        "gripper_port": gripper_port,
        "camera": camera,
        "camera_device": camera_device,
        "wrench_port": wrench_port,
        "io_address": io_address,
        "find_by": find_by,
        "plate": plate,
    }
    _write(_answered(cast("ArmName", cell), given, name, is_asking=sys.stdin.isatty() if ask is None else ask), folder)


def _answered(arm: ArmName, given: dict[str, str | None], name: str | None, *, is_asking: bool) -> RealCell:
    """Return the answers, with questions for those that are missing, or else their usual values."""
    from service.commissioning.real_arms import ARMS as KNOWN
    from service.commissioning.real_cell import RealCell

    usual = RealCell.usual(arm)
    answers: dict[str, Any] = {"arm": arm, "name": name or usual.name}
    for key, words in QUESTIONS.items():
        if key == "gripper_port" and KNOWN[arm].shares_link:
            continue
        default = f"{usual.plate_m[0]:g}x{usual.plate_m[1]:g}" if key == "plate" else str(getattr(usual, key))
        if key == "io_address" and answers.get("find_by", given["find_by"]) in ("tags", "outline"):
            default = "-"  # nothing else needs it
        said = given[key]
        if said is None:
            said = typer.prompt(words, default=default) if is_asking else default
        answers[key] = "" if said == "-" else said
    if answers["find_by"] not in FIND_BY:
        raise InvalidRequest(f"a panel is not found by {answers['find_by']!r}", hint=f"one of {', '.join(FIND_BY)}")
    answers["plate_m"] = _size(answers.pop("plate"))
    return RealCell(**answers)


def _size(text: str) -> tuple[float, float]:
    try:
        width, height = (float(side) for side in text.lower().replace(",", "x").split("x"))
    except ValueError:
        raise InvalidRequest(f"{text!r} is no size", hint="width x height in metres, such as 0.62x0.46") from None
    if not (0.05 <= width <= 5.0 and 0.05 <= height <= 5.0):
        raise InvalidRequest(f"a plate of {width:g} x {height:g} m does not fit a cell", hint="give metres")
    return width, height


def _write(cell: RealCell, folder: Path) -> None:
    from service.commissioning.real_cell import write_real_cell

    files = write_real_cell(cell, folder)
    for path in files:
        console.print(f"wrote {path}", markup=False)
    option = f"--cell {files[0].relative_to(folder)}"
    _say_next(
        {
            f"cd {folder}": "reports, measurements and the journal go to runs/ there",
            f"panelwright doctor --no-connect {option}": "checks the files, and lists what is still to be measured",
            f"panelwright doctor {option}": "also connects to every device",
        }
    )
    console.print("docs/tutorials/first-real-cell.md leads from here to the first mission", markup=False)


def _copy(cell: Path, folder: Path) -> None:
    from service.commissioning.new_cell import copy_cell

    copied = copy_cell(cell, folder)
    for place, count in Counter(path.parent for path in copied.files).items():
        console.print(f"wrote {place}: {count} {'file' if count == 1 else 'files'}", markup=False)
    name = copied.cell.relative_to(folder)
    is_default = name == DEFAULT_CELL
    option = "" if is_default else f" --cell {name}"
    _say_next(
        {
            f"cd {folder}": "reports, measurements and the journal go to runs/ there",
            f"panelwright doctor{option}": "checks the cell file and this machine",
            f"panelwright demo{option}": "runs a whole mission",
            f"panelwright serve{option}": "serves the cell over HTTP",
        }
    )
    console.print(
        f"edit {name} (devices, drivers, where the panel stands) and {copied.panel.relative_to(folder)} (its objects)",
        markup=False,
    )


def _say_next(steps: dict[str, str]) -> None:
    console.print("\nwhat to do next:")
    for command, why in steps.items():
        console.print(f"  {command:<{max(map(len, steps))}}  {why}", markup=False)
