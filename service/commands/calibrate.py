"""`panelwright calibrate`: drives a sensor through the most informative stations and stores a dated record.

It starts the shipped simulated cell unless `--cell` names another one or `--url` a running service.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from service.client import Client
from service.commands.board import board
from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, client_of, console, read_cell
from service.commands.depth import depth
from service.commands.own_cell import ServiceUrl, run_on_cell, run_task
from service.commands.tip import tip
from service.commands.zero import zero

app = typer.Typer(
    help="Calibrate: the arm drives through poses, measures, and stores a versioned, dated record with its quality.",
    no_args_is_help=True,
)
app.command()(board)
app.command()(depth)
app.command()(tip)
app.command()(zero)
Poses = Annotated[int, typer.Option(min=4, max=40, help="Number of stations to measure from.")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only plan the stations; nothing moves and nothing is written.")
]
Runs = Annotated[Path, typer.Option(help="Folder of the records: RUNS/calibrations/CELL.")]
Device = Annotated[
    str | None, typer.Option(help="Device to calibrate; the first of its kind in the cell file if not given.")
]
RUNS = Path("runs")


def _add_command(what: str, poses_usual: int, summary: str) -> None:
    """Add the command that calibrates `what`; the commands differ only in this and in the number of stations."""

    def calibrate(
        *,
        cell: CellOption = DEFAULT_CELL,
        seed: SeedOption = None,
        poses: Poses = poses_usual,
        device: Device = None,
        dry_run: DryRun = False,
        runs: Runs = RUNS,
        url: ServiceUrl = None,
    ) -> None:
        _run(what, cell, seed, runs, url, {"poses": poses, "device": device, "dry_run": dry_run})

    app.command(what, help=summary)(calibrate)


_add_command("camera", 16, "Calibrate lens and mount of a camera whose lens is not known, with the panel's lights.")
_add_command("hand-eye", 12, "Calibrate the camera's mount in the hand, and the panel's pose, with the panel's lights.")
_add_command(
    "scanner", 12, "Calibrate the range scanner's mount in the hand by scans of the plate (calibrate the camera first)."
)
_add_command(
    "tool", 12, "Calibrate the force/torque sensor's bias and the tool's weight and centre of mass by turning the hand."
)


@app.command("list")
def list_records(
    *, cell: CellOption = DEFAULT_CELL, seed: SeedOption = None, runs: Runs = RUNS, url: ServiceUrl = None
) -> None:
    """List the records in use: version, date, method, one sigma."""
    if url is not None:
        entries = client_of(url).get("/v1/calibrations")["calibrations"]
    else:
        from service.knowledge.calibrations import Calibrations

        found = Calibrations.of_runs(runs, read_cell(cell, seed)).all()
        entries = [{**e.record.model_dump(), "is_measured": e.is_measured} for e in found]
    table = Table("device", "version", "date", "from", "method", "1 sigma", box=None, pad_edge=False)
    for entry in entries:
        origin = "[green]measured[/]" if entry["is_measured"] else "cell file"
        words = (entry["device"], str(entry["version"]), entry["date"], origin)
        table.add_row(*words, escape(entry["method"]), _sigma(entry["mount"]))
    console.print(table)


def _run(what: str, cell: Path, seed: int | None, runs: Path, url: str | None, body: dict[str, Any]) -> None:
    """Run a calibration as a task, on a running service or on a cell started for it; ends the process."""
    request = {"what": what, **{key: value for key, value in body.items() if value is not None}}
    run_on_cell(
        lambda client: _follow(client, request), cell=cell, seed=seed, runs=runs, url=url, moves=not body["dry_run"]
    )


def _follow(client: Client, request: dict[str, Any]) -> bool:
    task = run_task(client, "/v1/calibrations", request)
    result = task["result"]
    if result is None:
        return False
    _show_plan(result) if result["dry_run"] else _show_record(result)
    return True


def _show_plan(result: dict[str, Any]) -> None:
    table = Table("station", "x m", "y m", "z m", "flange looks along", box=None, pad_edge=False)
    for k, station in enumerate(result["stations"], 1):
        x, y, z, w = station["quaternion_xyzw"]
        along = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
        place = [f"{value:.3f}" for value in station["translation_m"]]
        table.add_row(str(k), *place, "  ".join(f"{value:+.2f}" for value in along))
    console.print(table)
    console.print(
        f"{len(result['stations'])} stations planned for {result['device']}; nothing moved, nothing was written"
    )


def _show_record(result: dict[str, Any]) -> None:
    record, change = result["record"], result["change"]
    console.print(f"[bold]{record['device']}[/] version {record['version']}, {record['method']}, {record['date']}")
    if result["what"] != "tool":
        console.print(f"  mount    one sigma {_sigma(record['mount'])}; moved by {_moved(change)}")
    if record.get("intrinsics") is not None and result["what"] != "tool":
        lens = record["intrinsics"]
        sigma = lens["fx_px"] * lens["sigma_focal_ratio"]
        console.print(f"  lens     focal length {lens['fx_px']:.2f} ± {sigma:.2f} px, residual {lens['rms_px']:.3f} px")
    if result["what"] == "tool":
        load, sigma_g = record["load"], 1e3 * record["quality"]["mass_sigma_kg"]
        bias = ", ".join(f"{value:+.2f}" for value in load["bias_force_n"])
        console.print(f"  tool     {1e3 * load['mass_kg']:.1f} ± {sigma_g:.1f} g; bias {bias} N")
    if "chi_square_ratio" in record["quality"]:
        console.print(f"  scatter  {math.sqrt(record['quality']['chi_square_ratio']):.2f} times the stated noise")
    console.print(f"  written  {result['path']}; in use from {result['in_use_from']}")


def _moved(change: dict[str, float]) -> str:
    return f"{1e3 * change['moved_m']:.2f} mm and {math.degrees(change['turned_rad']):.3f} deg"


def _sigma(mount: dict[str, Any] | None) -> str:
    if mount is None:
        return "no mount"
    return f"{1e3 * math.hypot(*mount['sigma_m']):.2f} mm {math.degrees(math.hypot(*mount['sigma_rad'])):.3f} deg"
