"""MQTT: the newest reading of each object and the state of each alarm as retained messages, in the order of the changes.

TOPIC/CELL/status             {"state": "online" | "service-silent" | "offline"}; offline is the will
TOPIC/CELL/objects/NAME       a reading; an invalid one says so and has no value
TOPIC/CELL/alarms/NAME        an alarm with its state
"""

from __future__ import annotations

import asyncio
import json
import logging
from typing import Any

import aiomqtt

from hal.outlets import MqttSection
from service.outlets.broker import client_of
from service.outlets.deliver import Backoff, Sleep, batches
from service.outlets.source import Changes, CursorFile, Source, told

QOS = 1  # at least once; the number in a message tells a repeat
log = logging.getLogger(__name__)


class MqttOutlet:
    """Publishes the changes of a cell to a broker; what happens while it is away follows when it is back.

    Args:
        password: of `section.username`.
        sleep: waits between tries.
    """

    def __init__(
        self,
        section: MqttSection,
        *,
        cell: str,
        source: Source,
        cursor: CursorFile,
        password: str | None = None,
        sleep: Sleep = asyncio.sleep,
    ) -> None:
        self._section, self._cell, self._source = section, cell, source
        self._cursor, self._password, self._sleep = cursor, password, sleep
        self._root = f"{section.topic}/{cell}"

    async def run(self) -> None:
        """Publish for ever."""
        backoff = Backoff(self._sleep)
        while True:
            try:
                async with self._client() as client:
                    log.info("MQTT: connected to %s", self._section.host)
                    backoff.worked()
                    await self._publish_all(client)
            except (aiomqtt.MqttError, OSError) as error:
                log.warning("MQTT: %s:%d: %s", self._section.host, self._section.port, error)
                await backoff.pause()

    def _client(self) -> aiomqtt.Client:
        will = aiomqtt.Will(f"{self._root}/status", _status("offline"), QOS, retain=True)
        return client_of(self._section, f"panelwright-{self._cell}", will, self._password)

    async def _publish_all(self, client: aiomqtt.Client) -> None:
        async def say(topic: str, message: Any) -> None:
            await client.publish(f"{self._root}/{topic}", json.dumps(message), QOS, retain=True)

        async def on_silence(is_silent: bool) -> None:
            await client.publish(
                f"{self._root}/status", _status("service-silent" if is_silent else "online"), QOS, retain=True
            )

        await on_silence(False)
        async for found in batches(self._source, self._cursor, on_silence=on_silence, sleep=self._sleep):
            if self._cursor.load().reading is None:  # the first time: tell the state, and from now on the changes
                found = await self._with_state(found)  # noqa: PLW2901 - the same batch with what was before it
            for reading in found.readings:
                await say(f"objects/{reading['object']}", told(reading))
            for alarm in found.alarms:
                await say(f"alarms/{alarm['id']}", dict(alarm))

    async def _with_state(self, found: Changes) -> Changes:
        state = await self._source.state()
        return Changes(
            readings=tuple(state.readings.values()), alarms=tuple(state.alarms.values()), cursor=found.cursor
        )


def _status(state: str) -> str:
    return json.dumps({"state": state})
