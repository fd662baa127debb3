"""`panelwright drivers [NAME]`: lists the installed drivers, or the options and the record of one of them."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from service.commands.common import console


def drivers(
    name: Annotated[str | None, typer.Argument(help="Driver whose options are shown, e.g. serial:tfmini.")] = None,
) -> None:
    """List all installed drivers, or every option of one with its unit, default and range, and an example."""
    _list() if name is None else _show(name)


def _list() -> None:
    from hal.registry import installed_drivers
    from service.commissioning.driver_options import describe
    from service.commissioning.driver_records import installed_record, tier_of

    table = Table("driver", "kind", "wire", "tier", box=None, pad_edge=False)
    for name in installed_drivers():
        info = describe(name)
        table.add_row(info.name, str(info.kind), info.wire, tier_of(installed_record(name)))
    console.print(table)


def _show(name: str) -> None:
    from service.commissioning.driver_options import describe
    from service.commissioning.driver_records import checks_of, installed_record, tier_of

    info, record = describe(name), installed_record(name)
    console.print(f"[bold]{info.name}[/]: {info.kind}, wire: {info.wire}, tier: {tier_of(record)}")
    if record is not None:
        words = {True: "yes", False: "no", None: "not measured"}
        console.print("; ".join(f"{check}: {words[result]}" for check, result in checks_of(record).items()))
    table = Table("key", "type", "unit", "default", "range", "meaning", box=None, pad_edge=False)
    for option in info.options:
        row = (option.key, option.type, option.unit, option.default, option.range, option.description)
        table.add_row(*map(escape, row))
    console.print(table)
    console.print("\nin a cell file:\n")
    console.print(info.example, markup=False, end="")
