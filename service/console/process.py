"""Entry point of the console's process, which `panelwright serve` starts; run as `python -m service.console.process`."""

from __future__ import annotations

import argparse
import os
import socket
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import app as nicegui_app
from nicegui import ui

from service.console import alarms_page, cell_page, devices_page, history_page, missions_page, panel_page, setup_page
from service.console.mirror import Mirror
from service.console.own_page import OwnPageOnly
from service.console.page_frame import Place
from service.console.relay import install_relay
from service.console.service_client import ServiceClient
from service.console.texts import say
from service.processes.child import Lifeline

WEB = Path(__file__).parent / "web"
PAGES = (panel_page, missions_page, alarms_page, history_page, devices_page, setup_page, cell_page)


def create_app(client: ServiceClient, *, port: int, stop_port: int, ready: threading.Event | None = None) -> FastAPI:
    """Return the application of the console.

    Args:
        client: the client of the service that it shows.
        port: its own port, from which a page in the browser finds the stop port, however it was reached.
        stop_port: port of the stop process.
        ready: set when it begins to answer.
    """
    mirror = Mirror(client)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        mirror.start()
        if ready is not None:
            ready.set()
        yield
        await mirror.close()

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)
    install_relay(app, client)
    nicegui_app.add_static_files("/web", WEB)
    place = Place(mirror=mirror, port=port, stop_port=stop_port)
    for page in PAGES:
        page.install(place)
    ui.run_with(
        app,
        title=say("title"),
        favicon=(WEB / "icon.svg"),
        dark=None,
        tailwind=False,
        show_welcome_message=False,
        reconnect_timeout=5.0,
        language="en-US",
    )
    app.add_middleware(OwnPageOnly)
    return app


def main() -> None:
    """Serve the console until the parent ends; this is the entry point of the process."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True, help="bound listening socket")
    parser.add_argument("--service", required=True, help="address of the HTTP API")
    parser.add_argument("--stop-port", type=int, required=True)
    options = parser.parse_args()
    lifeline = Lifeline()
    listener = socket.socket(fileno=options.fd)
    ready = threading.Event()
    app = create_app(
        ServiceClient(options.service), port=listener.getsockname()[1], stop_port=options.stop_port, ready=ready
    )

    def tell() -> None:
        ready.wait()
        lifeline.write_line("ready")

    def end_with_parent() -> None:
        lifeline.wait_for_end()
        os._exit(0)  # at once: there is nothing to save

    for work in (tell, end_with_parent):
        threading.Thread(target=work, daemon=True).start()
    config = uvicorn.Config(
        app, log_level="warning", access_log=False, server_header=False, timeout_graceful_shutdown=1
    )
    uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    main()
