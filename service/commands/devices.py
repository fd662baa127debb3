"""`panelwright devices …`: shows the devices of a running service, and reads, records and replays single devices."""

from __future__ import annotations

import json
import sys
import time
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Column, Table

from hal.errors import CellError, ConfigError, InvalidRequest
from service.client import Client
from service.commands.common import Url, UrlDefault, client_of, console, find_cell
from service.commands.shutdown import one_interrupt

if TYPE_CHECKING:
    from service.commissioning.watching import Row

app = typer.Typer(help="List, read, watch, record, replay and exchange devices.", invoke_without_command=True)
err_console = Console(stderr=True, highlight=False, soft_wrap=True)
Name = Annotated[str, typer.Argument(help="Name of the device in the cell file.")]
TimeoutOption = Annotated[float, typer.Option(min=0.01, max=60, help="Deadline of each reading, s.")]
SAVED = (".png", ".npz")  # lossless formats only, because the files hold measurements
STYLES = {"valid": "green", "degraded": "yellow", "invalid": "red"}


@app.callback()
def devices(context: typer.Context, url: Url = UrlDefault) -> None:
    """List the devices if no command is given."""
    # An option before the command applies to the command: `devices --url B swap …`.
    context.default_map = {name: {"url": url} for name in ("list", "read", "watch", "swap", "connect", "fault")}
    if context.invoked_subcommand is None:
        console.print(_table(client_of(url)))


@app.command("list")
def list_devices(url: Url = UrlDefault) -> None:
    """List all devices with their health."""
    console.print(_table(client_of(url)))


@app.command("read")
def read_device(
    name: Name,
    samples: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of readings.")] = 1,
    jsonl: Annotated[bool, typer.Option("--jsonl", help="Print one JSON object per line.")] = False,
    save: Annotated[
        Path | None, typer.Option(help="Write the reading to this file, as a picture (.png) or an array (.npz).")
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option("--cell", help="Connect the device of this cell file in this process, without a service."),
    ] = None,
    timeout_s: Annotated[float, typer.Option(min=0.01, max=60, help="Deadline of each reading with --cell, s.")] = 0.5,
    url: Url = UrlDefault,
) -> None:
    """Read a device of the running service or, with --cell, connect it in this process."""
    if cell is not None:
        if save is not None:
            raise ConfigError("--save needs a running service and --cell has none", hint="leave out one of the two")
        _read_directly(cell, name, samples=samples, jsonl=jsonl, timeout_s=timeout_s)
        return
    client = client_of(url)
    if save is not None:
        _keep(save, client.fetch("GET", f"/v1/devices/{name}/reading?format={_form_of(save)}"))
        return
    for _ in range(samples):
        reading = client.get(f"/v1/devices/{name}/reading")
        if jsonl:
            sys.stdout.write(json.dumps(reading) + "\n")
        else:
            console.print_json(json.dumps(reading))


def _keep(save: Path, data: bytes) -> None:
    try:
        save.write_bytes(data)
    except OSError as error:
        raise InvalidRequest(f"{save} cannot be written: {error.strerror}", hint="choose another --save") from None
    console.print(f"wrote {save}")


def _form_of(save: Path) -> str:
    """Return the format that the service must send for a file with that suffix."""
    form = save.suffix.lower()
    if form not in SAVED:
        raise InvalidRequest(
            f"--save {save}: cannot write {form or 'a file without suffix'}",
            hint=f"suffixes: {', '.join(SAVED)}",
        )
    return form.removeprefix(".")


def _read_directly(cell: Path, name: str, *, samples: int, jsonl: bool, timeout_s: float) -> None:
    """Print samples and errors of one device; the exit code is 1 when there was no sample."""
    from hal.config import load_cell
    from service.commissioning.direct_read import as_line, read_lines

    good = 0
    for item in read_lines(load_cell(find_cell(cell)), name, samples=samples, timeout_s=timeout_s):
        good += "error" not in item
        if jsonl:
            _write(item)
        else:
            console.print_json(as_line(item))
    if not good:
        raise typer.Exit(1)


@app.command("record")
def record_device(
    name: Name,
    out: Annotated[Path, typer.Argument(help="File to write (JSON lines).")],
    *,
    cell: Annotated[
        Path,
        typer.Option(
            "--cell", help="Cell file with the device, which is connected in this process, without a service."
        ),
    ],
    seconds: Annotated[float, typer.Option(min=0.1, max=86_400, help="Duration, s.")] = 10.0,
    jsonl: Annotated[bool, typer.Option("--jsonl", help="Also print the samples, one JSON object per line.")] = False,
    timeout_s: TimeoutOption = 0.5,
) -> None:
    """Record all traffic between a device and its driver."""
    from hal.config import load_cell
    from service.commissioning.recording import record

    tally = Tally(jsonl=jsonl)
    err_console.print(f"recording {name} for {seconds:g} s; Ctrl-C ends it earlier")
    items = record(load_cell(find_cell(cell)), name, out, duration_s=seconds, timeout_s=timeout_s)
    with one_interrupt(), suppress(KeyboardInterrupt):
        for item in items:
            tally.take(item)
    items.close()  # closes the device and completes the file
    err_console.print(f"{tally}; wrote {out} ({out.stat().st_size / 1024:.0f} KiB)")
    err_console.print(f"replay it with: panelwright devices replay {out}")


@app.command("replay")
def replay_device(
    recording: Annotated[Path, typer.Argument(help="File written by `record`.")],
    *,
    jsonl: Annotated[bool, typer.Option("--jsonl", help="Print the samples, one JSON object per line.")] = False,
    timeout_s: TimeoutOption = 0.5,
) -> None:
    """Run the driver of a recorded device on its recording instead of the wire, at the original pace."""
    from service.commissioning.recording import replay

    tally = Tally(jsonl=jsonl)
    err_console.print(f"replaying {recording} at the pace of the recording")
    for item in replay(recording, timeout_s=timeout_s):
        tally.take(item)
    err_console.print(str(tally))


class Tally:
    """Counts samples and errors, and prints them as JSON lines if wanted."""

    def __init__(self, *, jsonl: bool) -> None:
        self._jsonl = jsonl
        self._samples = self._errors = 0
        self._first_s = self._last_s = 0.0

    def take(self, item: dict[str, Any]) -> None:
        """Count one sample or error."""
        if self._jsonl:
            _write(item)
        if "error" in item:
            self._errors += 1
            return
        self._last_s = time.monotonic()  # the samples' own stamps may come from a slower clock
        self._first_s = self._first_s if self._samples else self._last_s
        self._samples += 1

    def __str__(self) -> str:
        lasted_s = self._last_s - self._first_s
        rate = f" in {lasted_s:.1f} s, {(self._samples - 1) / lasted_s:.0f} per second" if lasted_s > 0.0 else ""
        return f"{self._samples} samples{rate}, {self._errors} errors"


def _write(item: dict[str, Any]) -> None:
    from service.commissioning.direct_read import as_line

    sys.stdout.write(as_line(item))
    sys.stdout.flush()


@app.command("watch")
def watch_devices(
    url: Url = UrlDefault,
    *,
    period_s: Annotated[float, typer.Option(min=0.1, max=60, help="Time between two readings, s.")] = 1.0,
    pictures: Annotated[
        bool, typer.Option(help="Also read cameras and range scanners, which takes a picture each time.")
    ] = False,
    count: Annotated[int, typer.Option(min=0, help="Number of readings; 0 for no limit (until Ctrl-C).")] = 0,
) -> None:
    """Show values, rates, ages and error counters of all devices repeatedly."""
    from service.commissioning.watching import Watch

    client = client_of(url)
    watch, looks = Watch(client, with_pictures=pictures), 0
    with Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext() as live:
        while True:
            try:
                shown: Table | str = _watched(watch.look())
            except CellError as error:  # a service that answered before may come back
                if looks == 0:
                    raise
                shown = f"[red]{escape(error.what)}[/]; try: {escape(error.hint)}"
            if live is None:  # without a terminal, print each table below the one before
                console.print(shown)
            else:
                live.update(shown, refresh=True)
            looks += 1
            if looks == count:
                return
            time.sleep(period_s)


def _watched(rows: list[Row]) -> Table:
    columns = (
        Column("name", no_wrap=True),
        "driver",
        "health",
        "value",
        "samples/s",
        "age ms",
        "samples",
        "errors",
        "reconnects",
        "link",
    )
    table = Table(*columns, box=None, pad_edge=False)
    for row in rows:
        style = STYLES.get(row.health.split()[0], "red")
        errors = f"{row.errors} [red](+{row.errors_since})[/]" if row.errors_since else str(row.errors)
        table.add_row(
            row.name,
            row.driver,
            f"[{style}]{row.health}[/]",
            escape(row.value),
            "" if row.rate_hz is None else f"{row.rate_hz:.1f}",
            "" if row.age_s is None else f"{1e3 * row.age_s:.0f}",
            str(row.samples),
            errors,
            str(row.reconnects),
            escape(row.detail),
        )
    return table


@app.command("swap")
def swap_device(
    name: Name,
    driver: Annotated[str, typer.Argument(help="The other driver, e.g. serial:tfmini.")],
    options: Annotated[str, typer.Option(help="Its options as JSON.")] = "{}",
    url: Url = UrlDefault,
) -> None:
    """Replace a device's driver or options while the cell runs."""
    try:
        block = {"driver": driver, "options": json.loads(options)}
    except ValueError as error:
        raise ConfigError(f"--options is not JSON: {error}", hint='for example \'{"port": "/dev/ttyUSB0"}\'') from error
    _show_connected(client_of(url).put(f"/v1/devices/{name}", block))


@app.command("connect")
def connect_device(name: Name, url: Url = UrlDefault) -> None:
    """Connect a device again that was missing when the cell started, or whose driver has stopped."""
    _show_connected(client_of(url).post(f"/v1/devices/{name}/connect"))


def _show_connected(view: dict[str, Any]) -> None:
    health = view["health"]
    detail = f"; {escape(health['detail'])}" if health["detail"] else ""
    console.print(f"{view['name']}: {view['driver']}, {health['quality']}{detail}")


@app.command("fault")
def inject_fault(
    name: Name,
    fault: Annotated[str, typer.Argument(help="silent, stale, frozen, biased, disconnected, or none to end it.")],
    magnitude: Annotated[float, typer.Option(help="Size of the bias.")] = 0.0,
    url: Url = UrlDefault,
) -> None:
    """Inject a fault into a simulated device, or end it."""
    body = {"fault": None if fault == "none" else fault, "magnitude": magnitude}
    view = client_of(url).post(f"/v1/devices/{name}/fault", body)
    console.print(f"{name}: {view['health']['quality']} ({view['health']['cause']})")


def _table(client: Client) -> Table:
    table = Table("name", "kind", "driver", "health", "samples", "errors", "detail", box=None, pad_edge=False)
    for view in client.get("/v1/devices")["devices"]:
        health = view["health"]
        style = STYLES.get(health["quality"], "white") if health["connected"] else "red"
        word = health["quality"] if health["connected"] else "disconnected"
        cause = "" if health["cause"] == "none" else f" ({health['cause']})"
        counts = (str(health["samples"]), str(health["errors"]))
        shown = (view["name"], view["kind"], view["driver"], f"[{style}]{word}{cause}[/]")
        table.add_row(*shown, *counts, escape(health["detail"]))
    return table
