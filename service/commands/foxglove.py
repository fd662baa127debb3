"""`panelwright foxglove`: shows a running service in Foxglove."""

from __future__ import annotations

import json
import threading
from typing import Annotated

import typer

from service.commands.common import Url, UrlDefault, client_of, console


def foxglove(
    url: Url = UrlDefault,
    *,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="WebSocket port for Foxglove; 0 takes a free one.")
    ] = 8765,
    pictures: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=30.0,
            help="Images per second of each camera and scanner; 0 for none. A simulated sensor draws noise for each image, "
            "so with images the same seed gives another mission.",
        ),
    ] = 1.0,
) -> None:
    """Show joints, frames, wrench, images and tasks of a running service live in Foxglove, until Ctrl-C.

    Needs the extra `foxglove`. Foxglove connects by "Open connection", "Foxglove WebSocket".
    """
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    from hal.errors import DeviceUnavailable
    from service.commissioning.live_view import FRAMES_S, LiveView, repeat
    from service.recording.live import LiveServer

    client = client_of(url)
    client.get("/v1/info")
    server, end = LiveServer(port), threading.Event()
    view = LiveView(client, server)
    console.print(f"open [bold]{server.url}[/] in Foxglove (Foxglove WebSocket); Ctrl-C ends it")
    repeat(view.show_frames, FRAMES_S, end)
    repeat(view.show_tasks, FRAMES_S, end)
    if pictures > 0.0:
        repeat(view.show_pictures, 1.0 / pictures, end)
    try:
        with connect(f"{client.url.replace('http', 'ws', 1)}/v1/stream", proxy=None) as stream:
            for text in stream:
                view.show_state(json.loads(text))
    except (ConnectionClosed, OSError) as error:
        raise DeviceUnavailable(f"the service at {url} has ended", hint="start it again", device="service") from error
    except KeyboardInterrupt:
        console.print("the live view ends; the service goes on")
    finally:
        end.set()
        server.close()
