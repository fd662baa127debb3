"""`panelwright conform | emulate | new-driver`: commands for authors of drivers."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hal.errors import ConfigError
from service.commands.common import DEFAULT_CELL, SeedOption, console, read_cell
from service.terminal import ROOT

if TYPE_CHECKING:
    from hal.config import Cell


class LevelChoice(StrEnum):
    """Levels of the conformance kit."""

    STATIC = "static"
    CONNECT = "connect"
    READ = "read"
    MOTION = "motion"


def conform(
    cell: Annotated[Path, typer.Argument(help="Cell file whose devices are tested.")] = DEFAULT_CELL,
    *,
    device: Annotated[list[str] | None, typer.Option(help="Test only this device; may be given several times.")] = None,
    level: Annotated[
        LevelChoice, typer.Option(help="Highest level to test; `motion` moves arm and gripper and switches the lights.")
    ] = LevelChoice.READ,
    report: Annotated[
        Path | None, typer.Option(help="Path of the report without suffix; runs/conform-CELL if not given.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Folder of drivers' records (JSON), to which the results are added.")
    ] = None,
    seed: SeedOption = None,
) -> None:
    """Run the conformance tests on the devices of a cell, and write a report (Markdown and JSON)."""
    from hal.config import load_cell
    from service.commissioning.conform import run
    from service.commissioning.preflight import check_wires
    from service.terminal import find_cell

    loaded = load_cell(find_cell(cell), seed=seed)  # not checked as a whole, because an unfinished cell may have no arm
    check_wires(loaded)
    for name in device or ():
        if name not in loaded.file.devices:
            raise ConfigError(
                f"{loaded.path} has no device {name!r}", hint=f"devices: {', '.join(loaded.file.devices)}"
            )
    stem = report or Path("runs") / f"conform-{loaded.name}"
    code = run(loaded, devices=device or (), level=str(level), report=stem, record=record)
    console.print(f"report: {stem}.md, {stem}.json{'' if record is None else f'; records: {record}'}")
    raise typer.Exit(code)


def emulate(
    name: Annotated[
        str, typer.Argument(help="Device of the cell file whose wire is emulated, or the emulator, e.g. ur.")
    ],
    *,
    world: Annotated[
        bool,
        typer.Option("--world", help="Connect it to the simulated world of the first wire cell that has such a wire."),
    ] = False,
    cell: Annotated[
        Path | None, typer.Option("--cell", help="Cell file with emulators; cells/mixed.toml if not given.")
    ] = None,
) -> None:
    """Start the emulator of a device's wire, print how to reach it, and serve until Ctrl-C."""
    from hal.registry import Shared
    from service.processes.cell import clock_for, start_emulators

    shipped = sorted((ROOT / "cells").glob("wire-*.toml")) if world else [Path("cells/mixed.toml")]
    loaded, device = find_emulator(name, [cell] if cell is not None else shipped)
    section = loaded.file.emulators[device]
    alone = loaded.model_copy(update={"file": loaded.file.model_copy(update={"emulators": {device: section}})})
    shared = Shared()
    closers = [shared.close]
    console.print(f"starting {section.emulator} with {section.driver} of {loaded.path} behind it")
    try:
        clock = clock_for(loaded)
        address = start_emulators(alone, clock, shared, closers)[device].address
        driver = loaded.file.devices[device].driver
        console.print(
            f"{section.emulator} is up, with {section.driver} of {loaded.path} behind it; a driver finds it by"
        )
        console.print(f"driver = {inline_toml(driver)}\noptions = {inline_toml(address)}", markup=False)
        while True:  # the time of the simulated world passes only while somebody waits
            clock.sleep(1.0 / loaded.file.cell.control_rate_hz)
    finally:
        for close in closers[::-1]:
            close()


def find_emulator(name: str, cells: list[Path]) -> tuple[Cell, str]:
    """Return the first cell that emulates the device `name`, or that uses the emulator `name`, and the device.

    Raises:
        ConfigError: no cell does.
    """
    known: list[str] = []
    for path in cells:
        cell = read_cell(path, None)
        for device, section in cell.file.emulators.items():
            if name in (device, section.emulator):
                return cell, device
            known.append(f"{device} ({section.emulator})")
    raise ConfigError(
        f"{', '.join(str(path) for path in cells)}: nothing emulates {name!r}",
        hint=f"emulated there: {', '.join(known) or 'nothing'}; --world looks in the wire cells",
    )


def inline_toml(value: Any) -> str:
    """Return a value as one line of TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {inline_toml(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(inline_toml(entry) for entry in value) + "]"
    return json.dumps(value)


def new_driver(
    what: Annotated[str, typer.Argument(help="KIND:NAME, e.g. scanner:foo; the name becomes the name of a module.")],
    *,
    transport: Annotated[str, typer.Option(help="Transport: serial or tcp.")] = "serial",
    folder: Annotated[
        Path, typer.Option(help="panelwright's own source tree, or the folder for a separate package.")
    ] = Path(),
    package: Annotated[
        str | None, typer.Option(help="Name of the separate package; panelwright_NAME if not given.")
    ] = None,
) -> None:
    """Write a new driver that runs at once (options, emulator, conformance test, page), to be adapted to the device."""
    from service.commissioning.new_driver import parse_kind, write_driver

    kind, name = parse_kind(what)
    written = write_driver(kind, name, transport=transport, folder=folder, package=package)
    for path in written.files:
        console.print(f"wrote {path}")
    for path in written.registered:
        console.print(f"registered {transport}:{name} in {path}")
    console.print(f"try it: {written.try_it}")
    console.print(f"then, for cell files to find it: {written.install}")
