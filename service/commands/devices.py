"""`panelwright devices …`: look at the devices of a running service, or at one device of a cell file."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from hal.errors import ConfigError
from service.client import ApiError, Client
from service.commands.common import Url, UrlDefault, client_of, console, find_cell

app = typer.Typer(help="Look at the devices of a running service.", invoke_without_command=True)
Name = Annotated[str, typer.Argument(help="Name of the device in the cell file.")]
STYLES = {"valid": "green", "degraded": "yellow", "invalid": "red"}


@app.callback()
def devices(context: typer.Context, url: Url = UrlDefault) -> None:
    """List the devices when no command is given."""
    if context.invoked_subcommand is None:
        console.print(_table(client_of(url)))


@app.command("list")
def list_devices(url: Url = UrlDefault) -> None:
    """All devices with their health."""
    console.print(_table(client_of(url)))


@app.command("read")
def read_device(
    name: Name,
    samples: Annotated[int, typer.Option(min=1, max=1_000_000, help="How many readings.")] = 1,
    jsonl: Annotated[bool, typer.Option("--jsonl", help="One JSON object a line.")] = False,
    save: Annotated[Path | None, typer.Option(help="Write a picture (.png) or array (.npz) instead.")] = None,
    cell: Annotated[
        Path | None, typer.Option("--cell", help="Connect the device of this cell file here, without a service.")
    ] = None,
    timeout_s: Annotated[float, typer.Option(min=0.01, max=60, help="Deadline of each reading, with --cell.")] = 0.5,
    url: Url = UrlDefault,
) -> None:
    """Read a device of the running service or, with --cell, connect it in this process."""
    if cell is not None:
        _read_directly(cell, name, samples=samples, jsonl=jsonl, timeout_s=timeout_s)
        return
    client = client_of(url)
    if save is not None:
        form = "npz" if save.suffix == ".npz" else "png"
        save.write_bytes(client.fetch("GET", f"/v1/devices/{name}/reading?format={form}"))
        console.print(f"wrote {save}")
        return
    for _ in range(samples):
        reading = client.get(f"/v1/devices/{name}/reading")
        if jsonl:
            sys.stdout.write(json.dumps(reading) + "\n")
        else:
            console.print_json(json.dumps(reading))


def _read_directly(cell: Path, name: str, *, samples: int, jsonl: bool, timeout_s: float) -> None:
    """Print samples and errors of one device; exit code 1 when there was no sample at all."""
    from hal.config import load_cell
    from service.direct_read import as_line, read_lines

    good = 0
    for item in read_lines(load_cell(find_cell(cell)), name, samples=samples, timeout_s=timeout_s):
        good += "error" not in item
        if jsonl:
            sys.stdout.write(as_line(item))
            sys.stdout.flush()
        else:
            console.print_json(as_line(item))
    if not good:
        raise typer.Exit(1)


@app.command("watch")
def watch_devices(url: Url = UrlDefault, period_s: Annotated[float, typer.Option(min=0.1)] = 1.0) -> None:
    """Health of all devices, again and again, until Ctrl-C."""
    client = client_of(url)
    with Live(_table(client), console=console) as live:
        while True:
            time.sleep(period_s)
            live.update(_table(client))


@app.command("swap")
def swap_device(
    name: Name,
    driver: Annotated[str, typer.Argument(help="Another driver, e.g. serial:tfmini.")],
    options: Annotated[str, typer.Option(help="Its options, as JSON.")] = "{}",
    url: Url = UrlDefault,
) -> None:
    """Connect another driver in the place of a device while the cell runs."""
    try:
        block = {"driver": driver, "options": json.loads(options)}
    except ValueError as error:
        raise ConfigError(f"--options is not JSON: {error}", hint='for example \'{"port": "/dev/ttyUSB0"}\'') from error
    view = client_of(url).put(f"/v1/devices/{name}", block)
    console.print(f"{name}: {view['driver']}, {view['health']['quality']}; {escape(view['health']['detail'])}")


@app.command("fault")
def inject_fault(
    name: Name,
    fault: Annotated[str, typer.Argument(help="silent, stale, frozen, biased, disconnected, or none to end it.")],
    magnitude: Annotated[float, typer.Option(help="Size of a bias.")] = 0.0,
    url: Url = UrlDefault,
) -> None:
    """Begin or end a fault in a simulated device."""
    body = {"fault": None if fault == "none" else fault, "magnitude": magnitude}
    view = client_of(url).post(f"/v1/devices/{name}/fault", body)
    console.print(f"{name}: {view['health']['quality']} ({view['health']['cause']})")


def _table(client: Client) -> Table:
    table = Table("name", "kind", "driver", "health", "samples", "errors", "detail", box=None, pad_edge=False)
    try:
        views = client.get("/v1/devices")["devices"]
    except ApiError as error:
        table.caption = escape(error.what)
        return table
    for view in views:
        health = view["health"]
        style = STYLES.get(health["quality"], "white") if health["connected"] else "red"
        word = health["quality"] if health["connected"] else "disconnected"
        cause = "" if health["cause"] == "none" else f" ({health['cause']})"
        counts = (str(health["samples"]), str(health["errors"]))
        shown = (view["name"], view["kind"], view["driver"], f"[{style}]{word}{cause}[/]")
        table.add_row(*shown, *counts, escape(health["detail"]))
    return table
