"""`panelwright serve`: starts a cell and serves it over HTTP until Ctrl-C."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.markup import escape

from service.client import for_service
from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, console, read_cell
from service.commands.shutdown import leave
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from service.core import Service
    from service.exposure import Exposure
    from service.serve import Panelwright

START_PATIENCE_S = 120.0
app = typer.Typer()
Host = Annotated[
    str, typer.Option(help="Address to listen on; any other than loopback needs keys, and TLS or a proxy.")
]
Names = Annotated[
    list[str] | None,
    typer.Option("--name", help="A further name under which clients reach it; may be given several times."),
]
TlsCert = Annotated[Path | None, typer.Option(help="Certificate (PEM), with the chain.")]
TlsKey = Annotated[Path | None, typer.Option(help="Private key of the certificate (PEM).")]
BehindProxy = Annotated[
    bool,
    typer.Option(
        "--behind-proxy", help="A proxy with TLS stands before it; needs --name, and --proxy or --unix-socket."
    ),
]
Proxies = Annotated[
    list[str] | None, typer.Option("--proxy", help="IP address of that proxy; may be given several times.")
]
UnixSocket = Annotated[Path | None, typer.Option(help="A socket for that proxy, beside the port.")]

ConsolePage = Annotated[
    bool, typer.Option("--console/--no-console", help="Start the console, the pages for operators.")
]
ConsolePort = Annotated[
    int | None, typer.Option(min=0, max=65535, help="Port of the console; the second port after --port if not given.")
]


@app.command()
def serve(
    *,
    cell: CellOption = DEFAULT_CELL,
    port: Annotated[int, typer.Option(min=0, max=65534, help="HTTP port; 0 takes a free one.")] = 8460,
    stop_port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port of the stop process; the port after --port if not given.")
    ] = None,
    host: Host = "127.0.0.1",
    name: Names = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    behind_proxy: BehindProxy = False,
    proxy: Proxies = None,
    unix_socket: UnixSocket = None,
    runs: Annotated[Path, typer.Option(help="Folder for reports, journal and artefacts.")] = Path("runs"),
    seed: SeedOption = None,
    warm: Annotated[bool, typer.Option(help="Load the compiled kernels right after the start.")] = True,
    record: Annotated[
        Path | None, typer.Option(help="Record everything that the devices are asked and answer in this file (MCAP).")
    ] = None,
    console_page: ConsolePage = True,
    console_port: ConsolePort = None,
    inline: Annotated[bool, typer.Option("--inline", help="Cell and stop port in this process (debugging).")] = False,
) -> None:
    """Start the cell and serve it until Ctrl-C, even if some devices are missing."""
    from service.processes.early_cell import EarlyCell

    with ExitStack() as unfinished:
        early = None if inline else unfinished.enter_context(closing(EarlyCell()))  # imports while this process does
        from service.core import book_of
        from service.serve import Options, Panelwright

        exposure = _exposure(host, name, tls_cert, tls_key, behind_proxy, proxy, unix_socket)
        exposure.check(book_of(runs))  # before the cell file is read and kernels are compiled
        loaded = read_cell(cell, seed)
        compile_first()
        options = Options(
            exposure=exposure,
            port=port,
            stop_port=stop_port,
            runs_dir=runs,
            inline=inline,
            partial=True,
            warm=warm,
            record=record,
            console=console_page,
            console_port=console_port,
        )
        panelwright = Panelwright(loaded, options)
        if early is not None:
            panelwright.service.supervisor.begin_with(early)
        unfinished.pop_all()
    threading.Thread(target=_announce, args=(panelwright,), daemon=True).start()
    console.print(f"panelwright: cell [bold]{loaded.name}[/] ({loaded.file.cell.mode}) is starting")
    run_to_end(panelwright)


def _exposure(
    host: str,
    names: list[str] | None,
    tls_cert: Path | None,
    tls_key: Path | None,
    behind_proxy: bool,
    proxies: list[str] | None,
    unix_socket: Path | None,
) -> Exposure:
    from service.exposure import Exposure

    return Exposure(
        host=host,
        names=tuple(names or ()),
        tls_cert=tls_cert,
        tls_key=tls_key,
        behind_proxy=behind_proxy,
        proxies=tuple(proxies or ()),
        unix_socket=unix_socket,
    )


def run_to_end(panelwright: Panelwright) -> NoReturn:
    """Serve until Ctrl-C or SIGTERM, close everything, and end the process in bounded time.

    Raises:
        CellError: the cell could not start.
    """
    code, why = 0, ""
    try:
        panelwright.run()
    except KeyboardInterrupt:
        why = " by Ctrl-C"
    except SystemExit as end:
        code, why = (end.code if isinstance(end.code, int) else 1), " by SIGTERM"
    console.print(f"panelwright: stopped{why}; arm stopped, processes ended")
    leave(code)


def _announce(panelwright: Panelwright) -> None:
    panelwright.wait_until_settled(START_PATIENCE_S)
    if panelwright.error is None and not panelwright.is_ending:  # not after Ctrl-C during the start
        for line in announcement(panelwright.service, panelwright.url, panelwright.stop_url):
            console.print(line)
        if panelwright.console_url is not None:
            console.print(f"panelwright: console at [bold]{panelwright.console_url}[/]")


def announcement(service: Service, url: str, stop_url: str) -> Iterator[str]:
    """Yield what `serve` prints when the cell runs: addresses, missing devices with what is lost, and a latched stop."""
    missing = service.supervisor.missing
    state = f"without {len(missing)} of {len(service.cell.file.devices)} devices" if missing else "ready"
    yield f"panelwright: {state} at [bold]{url}[/]   stop: POST {stop_url}"
    yield from _access(service)
    for one in missing:
        connect = for_service(f"{one.hint}; then `panelwright devices connect {one.device}`", url)
        yield f"panelwright: without [bold]{one.device}[/]: {escape(one.why)}"
        yield f"  lost   {', '.join(service.lost_without(one.device)) or 'nothing but its readings'}"
        yield f"  try    {escape(connect)}"
    if service.supervisor.latch.is_set():
        reset = for_service("`panelwright stop --reset`", url)
        yield f"panelwright: the stop is latched; {reset} when the cell is clear"


def _access(service: Service) -> Iterator[str]:
    """Yield who may use the service."""
    book = service.keys
    if book.is_open:
        yield "panelwright: no keys: every program of this machine may move the arm (`panelwright keys add` changes this)"
        return
    active = book.active()
    names = ", ".join(f"{escape(key.name)} ({key.role})" for key in active[:8]) + (", …" if len(active) > 8 else "")
    yield f"panelwright: {len(active)} keys are valid: {names}" if active else "panelwright: no key is valid"
