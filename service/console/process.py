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

from hal.priorities import Priority, take_priority
from service.console import (
    alarms_page,
    cell_page,
    devices_page,
    history_page,
    mission_editor,
    missions_page,
    panel_page,
    review_page,
    rounds_page,
    setup_page,
    teach_page,
)
from service.console.log_in import LogInFirst, install_log_in
from service.console.own_page import LOCAL, OwnPageOnly, Reach
from service.console.page_frame import PATHS, Place
from service.console.people import People
from service.console.relay import install_relay
from service.console.service_client import ServiceClient
from service.console.texts import say
from service.processes.child import Lifeline
from service.processes.client_host import CONSOLE_PROOF

WEB = Path(__file__).parent / "web"
PAGES = (
    panel_page,
    missions_page,
    mission_editor,
    rounds_page,
    alarms_page,
    review_page,
    history_page,
    devices_page,
    setup_page,
    cell_page,
    teach_page,
)


def create_app(
    people: People, *, port: int, stop_port: int, reach: Reach = LOCAL, ready: threading.Event | None = None
) -> FastAPI:
    """Return the application of the console.

    Args:
        people: those who use it, with their sessions at the service.
        port: its own port, from which a page in the browser finds the stop port, however it was reached.
        stop_port: port of the stop process.
        reach: how browsers reach it.
        ready: set when it begins to answer.
    """

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        people.start()
        if ready is not None:
            ready.set()
        yield
        await people.close()

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)
    install_log_in(app, people)  # first, because the relay takes all that is left of /v1
    install_relay(app, people, is_local=reach.is_local)
    nicegui_app.add_static_files("/web", WEB)
    place = Place(port=port, stop_port=stop_port)
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
    app.add_middleware(
        LogInFirst, people=people, pages=frozenset([*PATHS.values(), mission_editor.PATH, teach_page.PATH])
    )
    app.add_middleware(OwnPageOnly, reach=reach)
    return app


def main() -> None:
    """Serve the console until the parent ends; this is the entry point of the process."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True, help="bound listening socket")
    parser.add_argument("--service", required=True, help="address of the HTTP API")
    parser.add_argument("--stop-port", type=int, required=True)
    parser.add_argument("--cookie", required=True, help="name of the cookie in which the service keeps a session")
    parser.add_argument("--name", action="append", default=[], help="name under which browsers reach it")
    parser.add_argument(
        "--proxy", action="append", help="address of a proxy before it; given empty for one of this machine"
    )
    parser.add_argument("--exposed", action="store_true", help="other machines reach it")
    parser.add_argument("--tls-cert")
    parser.add_argument("--tls-key")
    options = parser.parse_args()
    take_priority(Priority.CLIENT)
    lifeline = Lifeline()
    listener = socket.socket(fileno=options.fd)
    ready = threading.Event()
    client = ServiceClient(options.service, ca=options.tls_cert, secret=os.environ.pop(CONSOLE_PROOF, None))
    people = People(client, cookie=options.cookie)
    reach = Reach(
        names=frozenset(options.name),
        schemes=frozenset({"https" if options.tls_cert else "http", *(["https"] if options.proxy else [])}),
        peers=frozenset(options.proxy) if options.proxy else None,
        is_local=not options.exposed,
    )
    app = create_app(people, port=listener.getsockname()[1], stop_port=options.stop_port, reach=reach, ready=ready)

    def tell() -> None:
        ready.wait()
        lifeline.write_line("ready")

    def end_with_parent() -> None:
        lifeline.wait_for_end()
        os._exit(0)  # at once: there is nothing to save

    for work in (tell, end_with_parent):
        threading.Thread(target=work, daemon=True).start()
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=1,
        proxy_headers=False,
        ssl_certfile=options.tls_cert,
        ssl_keyfile=options.tls_key,
    )
    uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    main()
