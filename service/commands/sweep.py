"""`panelwright sweep`: operates every control of random panels, judges by the simulator's truth, and prints the tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hal.errors import Unsupported
from service.commands.common import DEFAULT_CELL, CellOption, console, find_cell
from service.commands.shutdown import INTERRUPTED, leave, one_interrupt
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from collections.abc import Sequence

    from service.sweep.ask import PanelRun
    from service.sweep.options import SweepOptions


Seeds = Annotated[str | None, typer.Option(help='Seeds such as "1-1000" or "1-20,40", in place of the two above.')]
Out = Annotated[Path, typer.Option(help="Folder of the results; panels that it has are not run again.")]

app = typer.Typer()


@app.command()
def sweep(
    *,
    first: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the first panel.")] = 1,
    panels: Annotated[int, typer.Option(min=1, help="Number of panels, of successive seeds.")] = 10,
    seeds: Seeds = None,
    cell: CellOption = DEFAULT_CELL,
    only: Annotated[
        str, typer.Option(help='Only these kinds or rows of the table, with commas between: "slider,wheel 720".')
    ] = "",
    known_pose: Annotated[
        bool, typer.Option("--known-pose", help="Give the panel's pose with a realistic error instead of locating it.")
    ] = False,
    mission: Annotated[
        bool, typer.Option("--mission", help="Order all deeds of a panel in one mission, with readings.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes of the local scheduler.")] = 1,
    scheduler: Annotated[
        str, typer.Option(help='Scheduler: "local", or tcp://host:port of a dask scheduler.')
    ] = "local",
    out: Out = Path("runs/sweep"),
    draw: Annotated[
        Path | None, typer.Option(help="Only write the panel and cell files into this folder, and run nothing.")
    ] = None,
) -> None:
    """Operate every control of random simulated panels through the HTTP API and judge by the simulator's truth.

    The exit code is 1 when a control was said to be done and was not, or when something moved that was not named.
    """
    from service.sweep.kept import seeds_of
    from service.sweep.options import SweepOptions, chosen

    options = SweepOptions(cell=find_cell(cell).resolve(), only=chosen(only), known_pose=known_pose, mission=mission)
    chosen_seeds = list(range(first, first + panels)) if seeds is None else seeds_of(seeds)
    if draw is not None:
        _draw(chosen_seeds, options, draw)
        return
    compile_first()
    leave(_run(chosen_seeds, options, scheduler=scheduler, workers=workers, out=out))


def _draw(seeds: Sequence[int], options: SweepOptions, folder: Path) -> None:
    """Write the panel and cell files of each seed."""
    from service.sweep.files import write_files

    for seed in seeds:
        (folder / str(seed)).mkdir(parents=True, exist_ok=True)
        console.print(f"wrote {write_files(seed, options.cell, folder / str(seed))}", markup=False)


def _run(seeds: Sequence[int], options: SweepOptions, *, scheduler: str, workers: int, out: Path) -> int:
    """Run the panels, print and write the tables of those that have ended, and return the exit code."""
    from service.sweep.kept import Kept
    from service.sweep.sweep import sweep as run_sweep
    from service.sweep.sweep import write
    from service.sweep.table import report

    runs: list[PanelRun] = []
    kept = Kept(out, options)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    code = 0
    with one_interrupt(), Progress(*columns, console=console) as bar:
        task = bar.add_task("panels", total=len(seeds))

        def note(run: PanelRun) -> None:
            runs.append(run)
            write(runs, options, out)  # a sweep of hours may be killed
            bar.update(task, advance=1)
            bar.console.print(_lines(run, each=len(seeds) == 1))

        try:
            runs = run_sweep(seeds, options, scheduler=scheduler, workers=workers, progress=note, kept=kept)
        except KeyboardInterrupt:
            code = INTERRUPTED
    if runs:
        console.print(report(runs), markup=False, highlight=False)
        written = [*write(runs, options, out), *_parquet(runs, out)]
        console.print("wrote " + ", ".join(str(path) for path in written), markup=False)
    is_untrue = any(deed.is_untrue for run in runs for deed in run.deeds)
    return code or (1 if is_untrue or any(run.problem for run in runs) else 0)


def _parquet(runs: Sequence[PanelRun], out: Path) -> tuple[Path, ...]:
    """Write the Parquet files; without DuckDB there are none, which is said."""
    from service.sweep.parquet import write_parquet

    try:
        return write_parquet(runs, out)
    except Unsupported as error:
        console.print(f"without Parquet files: {error.what}; {error.hint}", markup=False)
        return ()


def _lines(run: PanelRun, *, each: bool) -> str:
    """Return what became of a panel: how many deeds were right, and those that were not one by one."""
    if run.problem:
        return f"[red]panel {run.seed}[/] {escape(run.problem)}"
    right = sum(deed.is_right for deed in run.deeds)
    lines = [f"panel {run.seed}: {right} of {len(run.deeds)} right, {run.cell_s:.0f} s on the cell's clock"]
    for deed in run.deeds:
        if each or not deed.is_right:
            style = "red" if deed.is_untrue else "green" if deed.is_right else "yellow"
            lines.append(f"  [{style}]{escape(deed.line())}[/]")
    return "\n".join(lines)
