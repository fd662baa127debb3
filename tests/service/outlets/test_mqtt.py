"""Tests of the MQTT outlet against Mosquitto: retained state, order, a broker that goes away, a gateway that dies."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import socket
import subprocess
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from hal.outlets import MqttSection
from service.outlets.broker import BrokerClient
from service.outlets.mqtt import MqttOutlet
from service.outlets.source import CursorFile
from tests.service.outlets.fakes import FakeSource, no_pause

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/bin")
pytestmark = [
    pytest.mark.skipif(MOSQUITTO is None, reason="Mosquitto is not installed (apt-get install mosquitto)"),
    pytest.mark.third_party("mosquitto", []),
]


class Broker:
    """Mosquitto on a port of this machine, which tests end and start again."""

    def __init__(self) -> None:
        self.port = _free_port()
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen([str(MOSQUITTO), "-p", str(self.port)], stderr=subprocess.DEVNULL)

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def _free_port() -> int:
    """Return a free port that no client gets as its own: one that does would connect to itself while there is no broker."""
    for port in range(20_000 + os.getpid() % 10_000, 32_000):
        with socket.socket() as free, contextlib.suppress(OSError):
            free.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no free port")


@pytest.fixture
def broker() -> Iterator[Broker]:
    one = Broker()
    one.start()
    yield one
    one.stop()


class Plant:
    """The other side: it notes all that comes, and connects again after a broker's death."""

    def __init__(self, broker: Broker) -> None:
        self.got: list[tuple[str, Any]] = []
        self.connected = asyncio.Event()
        self._broker = broker

    async def run(self) -> None:
        while True:
            try:
                async with BrokerClient("127.0.0.1", self._broker.port) as client:
                    await client.subscribe("panelwright/#", qos=1)
                    self.connected.set()
                    async for message in client.messages:
                        self.got.append((str(message.topic), json.loads(bytes(message.payload))))  # type: ignore[arg-type]
            except aiomqtt.MqttError:
                self.connected.clear()
                await asyncio.sleep(0.02)

    def values(self) -> list[float]:
        """Return the values of the readings in the order in which they came."""
        return [message["value"] for topic, message in self.got if "/objects/" in topic]


@contextlib.asynccontextmanager
async def at_once(*runs: Any) -> AsyncIterator[list[asyncio.Task[None]]]:
    tasks = [asyncio.ensure_future(one) for one in runs]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def until(is_so: Callable[[], bool]) -> None:
    async with asyncio.timeout(30.0):
        while not is_so():  # noqa: ASYNC110 - what is waited for happens in another process
            await asyncio.sleep(0.01)


def outlet_of(broker: Broker, source: FakeSource, folder: Path, *, after: asyncio.Event | None = None) -> MqttOutlet:
    """Return an outlet, which after a failure waits until `after` is set."""

    async def sleep(seconds: float) -> None:
        await no_pause(seconds)
        if after is not None:
            await after.wait()

    section = MqttSection(host="127.0.0.1", port=broker.port)
    return MqttOutlet(section, cell="bench", source=source, cursor=CursorFile(folder / "mqtt.json"), sleep=sleep)


def test_the_newest_state_is_retained_for_whoever_comes_later(broker: Broker, tmp_path: Path) -> None:
    async def story() -> None:
        source, plant = FakeSource(), Plant(broker)
        source.reads(1.0)
        async with at_once(outlet_of(broker, source, tmp_path).run()):
            await until((tmp_path / "mqtt.json").exists)
            source.reads(None)
            source.alarms_change()
            await until(lambda: json.loads((tmp_path / "mqtt.json").read_text()) == {"reading": 2, "alarm": 1})
            async with at_once(plant.run()):
                await until(lambda: len(plant.got) >= 3)
        got = dict(plant.got)
        assert got["panelwright/bench/status"] == {"state": "online"}
        reading = got["panelwright/bench/objects/pressure"]
        assert (reading["id"], reading["value"], reading["quality"], reading["cause"]) == (2, None, "invalid", "glare")
        assert got["panelwright/bench/alarms/pressure.high"]["state"] == "unacknowledged"

    asyncio.run(story())


def test_a_broker_that_is_away_for_a_day_loses_doubles_and_reorders_nothing(broker: Broker, tmp_path: Path) -> None:
    """24 hours of 20 objects read each hour, while no broker answers."""

    async def story() -> None:
        source, plant = FakeSource(batch=50), Plant(broker)
        outlet = outlet_of(broker, source, tmp_path, after=plant.connected)  # this far side keeps no session
        async with at_once(plant.run(), outlet.run()):
            await until((tmp_path / "mqtt.json").exists)
            await until(plant.connected.is_set)
            source.reads(0.0)
            await until(lambda: plant.values() == [0.0])
            broker.stop()
            await until(lambda: not plant.connected.is_set())
            for k in range(1, 481):
                source.reads(float(k), object=f"object_{k % 20}")
            await asyncio.sleep(0.05)
            broker.start()
            await until(lambda: len(plant.values()) >= 480)
        ids = [message["id"] for topic, message in plant.got if "/objects/" in topic]
        unique = list(dict.fromkeys(ids))  # by its number, as a receiver of quality 1 does
        assert unique == sorted(unique)
        assert set(range(max(unique) - 478, max(unique) + 1)) <= set(unique)
        assert max(unique) == 481

    asyncio.run(story())


def test_a_cancellation_that_comes_together_with_the_brokers_answer_is_not_lost(broker: Broker) -> None:
    async def story() -> None:
        publishing: asyncio.Task[None]

        class Client(BrokerClient):
            def _on_publish(self, *args: Any) -> None:
                super()._on_publish(*args)
                publishing.cancel()

        plant = Plant(broker)
        async with at_once(plant.run()):
            await until(plant.connected.is_set)  # the broker has started
            async with Client("127.0.0.1", broker.port) as client:
                publishing = asyncio.ensure_future(client.publish("topic", "text", qos=1))
                await asyncio.wait({publishing}, timeout=30.0)
        assert publishing.cancelled()

    asyncio.run(story())


def test_a_gateway_that_is_killed_goes_on_after_what_was_delivered(broker: Broker, tmp_path: Path) -> None:
    async def story() -> None:
        source, plant = FakeSource(), Plant(broker)
        async with at_once(plant.run()):
            for k in range(5):
                async with at_once(outlet_of(broker, source, tmp_path).run()):
                    await until((tmp_path / "mqtt.json").exists)
                    source.reads(float(k))
                    await until(
                        lambda: json.loads((tmp_path / "mqtt.json").read_text())["reading"] == len(source.readings)
                    )
                source.reads(100.0 + k)  # while there is no gateway
            async with at_once(outlet_of(broker, source, tmp_path).run()):
                await until(lambda: json.loads((tmp_path / "mqtt.json").read_text())["reading"] == 10)
            await until(lambda: len(plant.values()) == 10)
        assert plant.values() == [value for k in range(5) for value in (float(k), 100.0 + k)]

    asyncio.run(story())


def test_a_silent_service_and_a_dead_gateway_are_told_apart(broker: Broker, tmp_path: Path) -> None:
    async def story() -> None:
        source, plant = FakeSource(), Plant(broker)

        def states() -> list[str]:
            return [message["state"] for topic, message in plant.got if topic.endswith("/status")]

        async with at_once(plant.run()):
            await until(plant.connected.is_set)
            source.is_silent = True
            async with at_once(outlet_of(broker, source, tmp_path).run()) as (task,):
                await until(lambda: states() == ["online", "service-silent"])
                source.is_silent = False
                await until(lambda: states() == ["online", "service-silent", "online"])
                task.cancel()
            assert "offline" not in states(), "a gateway that ends in order leaves the will unsent"

    asyncio.run(story())
