"""`panelwright chaos`: runs missions of a simulated cell while it breaks things, and judges by invariants."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from hal.errors import InvalidRequest
from service.commands.common import DEFAULT_CELL, CellOption, console, find_cell, read_cell
from service.commands.shutdown import INTERRUPTED, leave, one_interrupt
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from service.chaos.options import Round
    from service.chaos.run import Chaos


def chaos(
    *,
    minutes: Annotated[
        float, typer.Option(min=0.1, max=10_000.0, help="Begin no further round after this time.")
    ] = 30.0,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the faults and of their moments.")] = 1,
    cell: CellOption = DEFAULT_CELL,
    only: Annotated[str, typer.Option(help='Only these faults, with commas between: "kill cell,fill disk".')] = "",
    out: Annotated[Path, typer.Option(help="Folder for chaos.md, chaos.json and service.log.")] = Path("runs/chaos"),
) -> None:
    """Break a simulated cell on purpose while missions run: kill, hang, silence, corrupt and fill.

    It starts a service of its own on free ports. The exit code is 1 when an invariant did not hold.
    """
    from service.chaos.options import ChaosOptions
    from service.chaos.plant import Plant, serve_command
    from service.chaos.run import Chaos
    from service.chaos.table import report, write

    options = ChaosOptions(seed=seed, minutes=minutes, faults=_chosen(only))
    path = find_cell(cell).resolve()
    loaded = read_cell(path, None)
    if loaded.file.cell.mode != "sim":
        raise InvalidRequest(
            f"{path} is no simulated cell", hint="chaos stops arms in the middle of anything: use a cell of mode 'sim'"
        )
    compile_first()
    kinds = {name: section.kind.value for name, section in loaded.file.devices.items()}
    arm = next(name for name, kind in kinds.items() if kind == "arm")
    with tempfile.TemporaryDirectory(prefix="panelwright-chaos-") as folder:
        plant = Plant(command=serve_command(path, None), runs=Path(folder) / "runs")
        run = Chaos(plant, options, arm=arm, devices=tuple(kinds))
        rounds, code = _rounds(run)
        console.print(report(rounds, run.final), markup=False, highlight=False)
        files = write(out, rounds, run.final, lines=plant.lines)
    console.print("wrote " + ", ".join(str(file) for file in files), markup=False)
    leave(code or (1 if any(one.breaches for one in (*rounds, run.final)) else 0))


def _rounds(run: Chaos) -> tuple[list[Round], int]:
    """Run until the time is over or Ctrl-C; returns the rounds and the exit code of an interruption."""
    rounds: list[Round] = []
    with one_interrupt():
        try:
            for one in run.rounds():
                rounds.append(one)
                console.print(_line(one))
        except KeyboardInterrupt:
            return rounds, INTERRUPTED
    return rounds, 0


def _line(one: Round) -> str:
    times = [f"followed {one.followed_s:.1f} s" if one.followed_s is not None else ""]
    times += [f"back {one.back_s:.1f} s" if one.back_s is not None else ""]
    style = "red" if one.breaches else "green"
    told = ", ".join(filter(None, [escape(one.what), one.ended, *times]))
    head = f"{one.number:>4} [{style}]{one.fault:<18}[/] {told}"
    return "\n".join([head, *(f"       [red]{escape(breach)}[/]" for breach in one.breaches)])


def _chosen(text: str) -> tuple[str, ...]:
    """Return the faults in a list with commas.

    Raises:
        InvalidRequest: there is no such fault.
    """
    from service.chaos.faults import FAULTS

    names = tuple(name.strip() for name in text.split(",") if name.strip())
    known = [fault.name for fault in FAULTS]
    if wrong := [name for name in names if name not in known]:
        raise InvalidRequest(f"there is no fault {wrong[0]!r}", hint=f"known: {', '.join(known)}")
    return names
