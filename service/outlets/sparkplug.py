"""Sparkplug B 3.0: the cell as an edge node, its panel as the one device, with births, deaths, aliases and rebirth.

spBv1.0/GROUP/NBIRTH/CELL          bdSeq, Node Control/Rebirth
spBv1.0/GROUP/DBIRTH/CELL/PANEL    NAME, NAME/alarm/KIND: the newest of all, with names, units and ranges
spBv1.0/GROUP/DDATA/CELL/PANEL     what has changed, by alias; what happened while the broker was away is historical
spBv1.0/GROUP/DDEATH/CELL/PANEL    the service is silent
spBv1.0/GROUP/NDEATH/CELL          the will
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import aiomqtt

from hal.atomic_write import write_atomically
from hal.errors import CellError
from hal.outlets import SparkplugSection
from service.outlets.broker import client_of
from service.outlets.deliver import Backoff, Sleep, batches
from service.outlets.source import CursorFile, Source
from service.outlets.sparkplug_metrics import Device
from service.outlets.sparkplug_payload import BOOLEAN, UINT64, Metric, asks_for_rebirth, encoded

DEVICE = "panel"
log = logging.getLogger(__name__)


class HostGone(Exception):
    """The primary host application went offline: the node dies and waits for it, as the specification asks."""


class SparkplugOutlet:
    """Publishes a cell as an edge node; what happens while the broker is away follows as historical data.

    The specification sends data with quality of service 0. A batch counts as delivered when the broker has answered a request
    that was sent after it, so a connection that breaks loses nothing; what it repeats has the same time stamp.

    Args:
        births: file with the number of the next birth, bdSeq.
        password: of `section.username`.
        sleep, now_s: waits between tries, and tells the time since 1970.
    """

    _client: aiomqtt.Client  # of the connection that lives

    def __init__(
        self,
        section: SparkplugSection,
        *,
        cell: str,
        source: Source,
        cursor: CursorFile,
        births: Path,
        password: str | None = None,
        sleep: Sleep = asyncio.sleep,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._section, self._cell, self._source, self._cursor = section, cell, source, cursor
        self._births, self._password, self._sleep, self._now_s = births, password, sleep, now_s
        self._bd_seq = self._seq = 0
        self._device = Device((), now_ms=self._now_ms)
        self._is_born = False
        self._turn = asyncio.Lock()  # a rebirth comes between two messages

    async def run(self) -> None:
        """Publish for ever."""
        backoff = Backoff(self._sleep)
        while True:
            self._bd_seq, self._is_born = self._next_birth(), False
            self._client = self._new_client()
            try:
                async with self._client as client:
                    log.info("Sparkplug: connected to %s", self._section.host)
                    backoff.worked()
                    await self._live(client)
            except HostGone:
                log.info("Sparkplug: the primary host %s is offline", self._section.primary_host)
            except (aiomqtt.MqttError, OSError) as error:
                log.warning("Sparkplug: %s:%d: %s", self._section.host, self._section.port, error)
                await backoff.pause()

    def _new_client(self) -> aiomqtt.Client:
        will = aiomqtt.Will(self._topic("NDEATH"), self._death(), qos=1, retain=False)
        return client_of(self._section, f"panelwright-spb-{self._cell}", will, self._password)

    def _next_birth(self) -> int:
        """Return bdSeq of a new connection, which goes on after a restart."""
        try:
            number = int(self._births.read_text(encoding="utf-8")) % 256
        except (OSError, ValueError):
            number = 0
        self._births.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self._births, str((number + 1) % 256))
        return number

    async def _live(self, client: aiomqtt.Client) -> None:
        """Be a node until the connection breaks or the primary host goes."""
        host = self._section.primary_host
        host_is_there = asyncio.Event()
        await client.subscribe(self._topic("NCMD"), qos=1)
        if host is None:
            host_is_there.set()
        else:
            await client.subscribe(f"spBv1.0/STATE/{host}", qos=1)
        listening = asyncio.ensure_future(self._listen(client, host_is_there))
        working = asyncio.ensure_future(self._work(host_is_there))
        try:
            done, _ = await asyncio.wait((listening, working), return_when=asyncio.FIRST_COMPLETED)
            for one in done:
                one.result()
        except HostGone:
            await client.publish(self._topic("NDEATH"), self._death(), qos=1)  # an orderly end leaves the will unsent
            raise
        finally:
            for one in (listening, working):
                one.cancel()
            await asyncio.gather(listening, working, return_exceptions=True)

    async def _listen(self, client: aiomqtt.Client, host_is_there: asyncio.Event) -> None:
        async for message in client.messages:
            payload = message.payload if isinstance(message.payload, bytes | bytearray) else b""
            if str(message.topic).startswith("spBv1.0/STATE/"):
                if is_online(bytes(payload)):
                    host_is_there.set()
                elif host_is_there.is_set():
                    raise HostGone
            elif host_is_there.is_set() and asks_for_rebirth(bytes(payload)):
                log.info("Sparkplug: a rebirth is asked for")
                async with self._turn:
                    await self._bear()

    async def _work(self, host_is_there: asyncio.Event) -> None:
        await host_is_there.wait()
        async with self._turn:
            await self._bear()
        async for found in batches(self._source, self._cursor, on_silence=self._on_silence, sleep=self._sleep):
            await self._wait_for_birth()
            async with self._turn:
                metrics = self._device.changes(found)
                if metrics:
                    await self._publish("DDATA", metrics, DEVICE)
                    await self._client.subscribe(self._topic("NCMD"), qos=1)  # answered after all that was sent before

    async def _wait_for_birth(self) -> None:
        """Try until the device is born: data before its birth would be lost."""
        backoff = Backoff(self._sleep)
        while not self._is_born:
            async with self._turn:
                await self._bear_device()
            if not self._is_born:
                await backoff.pause()

    async def _on_silence(self, is_silent: bool) -> None:
        async with self._turn:
            if is_silent and self._is_born:
                await self._publish("DDEATH", (), DEVICE)
                self._is_born = False
            elif not is_silent:
                await self._bear_device()

    async def _bear(self) -> None:
        """Publish the births of the node and of its device."""
        self._seq = 0
        at_ms = self._now_ms()
        node = (
            Metric(name="bdSeq", datatype=UINT64, value=self._bd_seq, at_ms=at_ms),
            Metric(name="Node Control/Rebirth", datatype=BOOLEAN, value=False, at_ms=at_ms),
        )
        await self._publish("NBIRTH", node)
        await self._bear_device()

    async def _bear_device(self) -> None:
        """Publish all metrics of the device with their names; without an answer of the service it is not born yet."""
        try:
            instruments, state = await self._source.panel(), await self._source.state()
        except CellError as error:
            log.warning("Sparkplug: %s", error.what)
            self._is_born = False
            return
        self._device = Device(instruments, now_ms=self._now_ms)
        await self._publish("DBIRTH", self._device.birth(state), DEVICE)
        self._is_born = True

    async def _publish(self, kind: str, metrics: Sequence[Metric], device: str | None = None) -> None:
        payload = encoded(metrics, at_ms=self._now_ms(), seq=self._seq)
        self._seq = (self._seq + 1) % 256
        await self._client.publish(self._topic(kind, device), payload, qos=0)

    def _death(self) -> bytes:
        at_ms = self._now_ms()
        return encoded([Metric(name="bdSeq", datatype=UINT64, value=self._bd_seq, at_ms=at_ms)], at_ms=at_ms, seq=None)

    def _topic(self, kind: str, device: str | None = None) -> str:
        end = "" if device is None else f"/{device}"
        return f"spBv1.0/{self._section.group}/{kind}/{self._cell}{end}"

    def _now_ms(self) -> int:
        return round(1000 * self._now_s())


def is_online(payload: bytes) -> bool:
    """Return whether a STATE message says that the host application is online."""
    try:
        return json.loads(payload)["online"] is True
    except (ValueError, LookupError, TypeError):
        return False
