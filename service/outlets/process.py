"""Entry point of the gateway's process, which `panelwright serve` starts; run as `python -m service.outlets.process`."""

from __future__ import annotations

import argparse
import asyncio
import functools
import logging
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from hal.errors import CellError
from hal.outlets import (
    MqttSection,
    OpcuaSection,
    OutletsSection,
    PrometheusSection,
    SparkplugSection,
    WebhookSection,
)
from hal.priorities import Priority, take_priority
from service.outlets.api import ApiSource
from service.outlets.deliver import Backoff, Sleep, password_of, secret_in
from service.outlets.source import CursorFile, Source
from service.processes.child import Lifeline
from service.processes.client_host import OUTLETS, OUTLETS_KEY

SETTLED_S = 60.0  # an outlet that ran so long begins again after the shortest pause
log = logging.getLogger(__name__)


class Outlet(Protocol):
    """What tells a cell to other programs."""

    async def run(self) -> None:
        """Tell for ever."""
        ...


Make = Callable[[], Outlet]


def outlets_of(section: OutletsSection, *, cell: str, source: Source, folder: Path) -> dict[str, Make]:
    """Return what makes the outlets of a section, by their names; making one imports its libraries.

    Args:
        folder: for cursors and dead letters.
    """
    makers: dict[str, Callable[..., Outlet]] = {
        "mqtt": _mqtt,
        "webhook": _webhook,
        "prometheus": _prometheus,
        "sparkplug": _sparkplug,
        "opcua": _opcua,
    }
    return {
        name: functools.partial(make, getattr(section, name), cell=cell, source=source, folder=folder)
        for name, make in makers.items()
        if getattr(section, name) is not None
    }


def _mqtt(section: MqttSection, *, cell: str, source: Source, folder: Path) -> Outlet:
    from service.outlets.mqtt import MqttOutlet

    cursor, password = CursorFile(folder / "mqtt.json"), password_of(section)
    return MqttOutlet(section, cell=cell, source=source, cursor=cursor, password=password)


def _webhook(section: WebhookSection, *, cell: str, source: Source, folder: Path) -> Outlet:
    from service.outlets.webhook import WebhookOutlet

    return WebhookOutlet(
        section,
        cell=cell,
        source=source,
        cursor=CursorFile(folder / "webhook.json"),
        secret=secret_in(section.secret_file) or "",
        dead_letters=folder / "dead-letters.jsonl",
    )


def _prometheus(section: PrometheusSection, *, cell: str, source: Source, folder: Path) -> Outlet:
    del folder  # it keeps nothing
    from service.outlets.prometheus import PrometheusOutlet

    return PrometheusOutlet(section, cell=cell, source=source)


def _sparkplug(section: SparkplugSection, *, cell: str, source: Source, folder: Path) -> Outlet:
    from service.outlets.sparkplug import SparkplugOutlet

    return SparkplugOutlet(
        section,
        cell=cell,
        source=source,
        cursor=CursorFile(folder / "sparkplug.json"),
        births=folder / "sparkplug-births",
        password=password_of(section),
    )


def _opcua(section: OpcuaSection, *, cell: str, source: Source, folder: Path) -> Outlet:
    del folder  # it keeps nothing
    from service.outlets.opcua import OpcuaOutlet

    return OpcuaOutlet(section, cell=cell, source=source, password=password_of(section))


async def run(outlets: Mapping[str, Make], *, sleep: Sleep = asyncio.sleep) -> None:
    """Run the outlets beside each other for ever; one that fails is made anew after a pause, and the others never notice.

    Args:
        sleep: waits between tries.
    """
    await asyncio.gather(*(_keep_running(name, make, sleep) for name, make in outlets.items()))


async def _keep_running(name: str, make: Make, sleep: Sleep) -> None:
    loop, backoff = asyncio.get_running_loop(), Backoff(sleep)
    while True:
        begun_s = loop.time()
        try:
            await make().run()
            log.error("%s: the outlet has ended; it begins again", name)
        except Exception as error:
            is_known = isinstance(error, CellError | OSError)
            log.error("%s: the outlet failed and begins again: %s", name, error, exc_info=not is_known)
        if loop.time() - begun_s > SETTLED_S:
            backoff.worked()
        await backoff.pause()


def main() -> None:
    """Run the outlets until the parent ends; this is the entry point of the process."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--service", required=True, help="address of the HTTP API")
    parser.add_argument("--ca", type=Path, default=None, help="certificate of the service")
    parser.add_argument("--cell", required=True)
    parser.add_argument("--folder", type=Path, required=True, help="folder for cursors and dead letters")
    options = parser.parse_args()
    take_priority(Priority.CLIENT)
    logging.basicConfig(level=logging.INFO, format="gateway: %(message)s")
    logging.getLogger("httpx2").setLevel(logging.WARNING)
    section = OutletsSection.model_validate_json(os.environ.pop(OUTLETS))
    source = ApiSource(
        options.service,
        key=os.environ.pop(OUTLETS_KEY, None),
        key_to_acknowledge=secret_in(None if section.opcua is None else section.opcua.key_file),
        ca=options.ca,
    )
    lifeline = Lifeline()

    def end_with_parent() -> None:
        lifeline.wait_for_end()
        os._exit(0)  # at once: cursors say what was delivered

    threading.Thread(target=end_with_parent, daemon=True).start()
    outlets = outlets_of(section, cell=options.cell, source=source, folder=options.folder)
    lifeline.write_line("ready")
    asyncio.run(run(outlets))


if __name__ == "__main__":
    main()
