"""Entry point of the gateway's process, which `panelwright serve` starts; run as `python -m service.outlets.process`."""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from hal.outlets import OutletsSection
from hal.priorities import Priority, take_priority
from service.outlets.api import ApiSource
from service.outlets.deliver import password_of, secret_in
from service.outlets.source import CursorFile, Source
from service.processes.child import Lifeline
from service.processes.client_host import OUTLETS, OUTLETS_KEY

Run = Callable[[], Coroutine[Any, Any, None]]


def outlets_of(section: OutletsSection, *, cell: str, source: Source, folder: Path) -> list[Run]:
    """Return what runs the outlets of a section; only their libraries are imported.

    Args:
        folder: for cursors and dead letters.
    """
    found: list[Run] = []
    if section.mqtt is not None:
        from service.outlets.mqtt import MqttOutlet

        found.append(
            MqttOutlet(
                section.mqtt,
                cell=cell,
                source=source,
                cursor=CursorFile(folder / "mqtt.json"),
                password=password_of(section.mqtt),
            ).run
        )
    if section.webhook is not None:
        from service.outlets.webhook import WebhookOutlet

        found.append(
            WebhookOutlet(
                section.webhook,
                cell=cell,
                source=source,
                cursor=CursorFile(folder / "webhook.json"),
                secret=secret_in(section.webhook.secret_file) or "",
                dead_letters=folder / "dead-letters.jsonl",
            ).run
        )
    if section.prometheus is not None:
        from service.outlets.prometheus import PrometheusOutlet

        found.append(PrometheusOutlet(section.prometheus, cell=cell, source=source).run)
    if section.sparkplug is not None:
        from service.outlets.sparkplug import SparkplugOutlet

        found.append(
            SparkplugOutlet(
                section.sparkplug,
                cell=cell,
                source=source,
                cursor=CursorFile(folder / "sparkplug.json"),
                births=folder / "sparkplug-births",
                password=password_of(section.sparkplug),
            ).run
        )
    if section.opcua is not None:
        from service.outlets.opcua import OpcuaOutlet

        found.append(OpcuaOutlet(section.opcua, cell=cell, source=source, password=password_of(section.opcua)).run)
    return found


async def run(runs: list[Run]) -> None:
    """Run the outlets beside each other; the first that fails by a defect ends all, and the service starts them again."""
    async with asyncio.TaskGroup() as group:
        for one in runs:
            group.create_task(one())


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
    runs = outlets_of(section, cell=options.cell, source=source, folder=options.folder)
    lifeline.write_line("ready")
    asyncio.run(run(runs))


if __name__ == "__main__":
    main()
