"""Tests of the Sparkplug B outlet against Mosquitto, with the Tahu project's decoder as judge of each payload."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from hal.outlets import SparkplugSection
from service.outlets.source import CursorFile
from service.outlets.sparkplug import SparkplugOutlet
from service.outlets.sparkplug_payload import BOOLEAN, DOUBLE, INT32, STRING, UINT64, Metric, asks_for_rebirth, encoded
from tests.service.outlets.fakes import FakeSource, no_pause
from tests.service.outlets.node_packages import NODE, folder_of
from tests.service.outlets.test_mqtt import MOSQUITTO, Broker, at_once, broker, until

DECODER = Path(__file__).with_name("sparkplug_decoder.js")
REBIRTH = encoded([Metric(name="Node Control/Rebirth", datatype=BOOLEAN, value=True, at_ms=1)], at_ms=1, seq=0)
TOPIC = "spBv1.0/plant"
needs_broker = pytest.mark.skipif(MOSQUITTO is None, reason="Mosquitto is not installed (apt-get install mosquitto)")
assert broker  # the fixture


def decoded(payloads: list[bytes]) -> list[dict[str, Any]]:
    """Return payloads as the package sparkplug-payload reads them."""
    packages = folder_of("sparkplug-payload", "1.0.3")
    done = subprocess.run(
        [str(NODE), str(DECODER)],
        input="\n".join(one.hex() for one in payloads),
        env={**os.environ, "NODE_PATH": str(packages / "node_modules")},
        capture_output=True,
        text=True,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


class Host:
    """A host application: it notes the messages of the node as they come."""

    def __init__(self, broker: Broker) -> None:
        self.got: list[tuple[str, bytes]] = []
        self.connected = asyncio.Event()
        self._broker = broker

    async def run(self) -> None:
        while True:
            try:
                async with aiomqtt.Client("127.0.0.1", self._broker.port) as client:
                    await client.subscribe("spBv1.0/#", qos=1)
                    self.connected.set()
                    async for message in client.messages:
                        assert isinstance(message.payload, bytes | bytearray)
                        topic = str(message.topic)
                        if "NCMD" not in topic and "STATE" not in topic:
                            self.got.append((topic.removeprefix(f"{TOPIC}/"), bytes(message.payload)))
            except aiomqtt.MqttError:
                self.connected.clear()
                await asyncio.sleep(0.02)

    def kinds(self) -> list[str]:
        return [topic.partition("/")[0] for topic, _payload in self.got]

    async def says(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        async with aiomqtt.Client("127.0.0.1", self._broker.port) as client:
            await client.publish(topic, payload, qos=1, retain=retain)


def outlet_of(broker: Broker, source: FakeSource, folder: Path, **given: Any) -> SparkplugOutlet:
    section = SparkplugSection(host="127.0.0.1", port=broker.port, group="plant", **given)
    cursor = CursorFile(folder / "sparkplug.json")
    return SparkplugOutlet(
        section,
        cell="bench",
        source=source,
        cursor=cursor,
        births=folder / "births",
        sleep=no_pause,
        now_s=lambda: 1.79e9 + 5,
    )


def told(metric: dict[str, Any]) -> tuple[Any, ...]:
    return (
        metric.get("name"),
        metric.get("value"),
        bool(metric.get("isHistorical")),
        metric["properties"]["Quality"]["value"],
    )


@needs_broker
@pytest.mark.third_party("sparkplug-payload", [])
def test_births_data_rebirth_and_the_death_are_what_the_decoder_of_others_reads(broker: Broker, tmp_path: Path) -> None:
    folder_of("sparkplug-payload", "1.0.3")
    source, host = FakeSource(), Host(broker)

    async def story() -> None:
        source.reads(4.5)
        async with at_once(host.run()):
            await until(host.connected.is_set)
            async with at_once(outlet_of(broker, source, tmp_path).run()) as (node,):
                await until((tmp_path / "sparkplug.json").exists)
                source.reads(5.0, utc_s=1.79e9 + 1)
                source.reads(None, utc_s=1.79e9 + 2)
                source.reads(3.0, utc_s=1.79e9 - 60)  # of an earlier time
                await until(lambda: "DDATA" in host.kinds())
                await host.says(f"{TOPIC}/NCMD/bench", REBIRTH)
                await until(lambda: host.kinds().count("DBIRTH") == 2)
                source.is_silent = True
                source.reads(6.0, utc_s=1.79e9 + 3)
                await until(lambda: "DDEATH" in host.kinds())
                source.is_silent = False
                await until(lambda: host.kinds().count("DBIRTH") == 3)
                assert not node.done()
            async with at_once(outlet_of(broker, source, tmp_path).run()):
                await until(lambda: host.kinds().count("NBIRTH") == 3)

    asyncio.run(story())
    topics, found = [topic for topic, _payload in host.got], decoded([payload for _topic, payload in host.got])
    assert topics[:3] == ["NBIRTH/bench", "DBIRTH/bench/panel", "DDATA/bench/panel"]
    births = [one for topic, one in zip(topics, found, strict=True) if topic.startswith("NBIRTH")]
    numbers = [next(m["value"] for m in one["metrics"] if m["name"] == "bdSeq") for one in births]
    assert numbers == [0, 0, 1], "a rebirth has the number of its connection, and the next connection the next"
    device = {metric["name"]: metric for metric in found[1]["metrics"]}
    assert told(device["pressure"]) == ("pressure", 4.5, False, 192)
    assert device["pressure"]["properties"]["engUnit"]["value"] == "bar"
    assert device["pressure"]["properties"]["engHigh"]["value"] == 10.0
    assert (device["temperature"]["value"], device["temperature"]["properties"]["Quality"]["value"]) == (None, 500)
    assert len({metric["alias"] for metric in found[1]["metrics"]}) == len(found[1]["metrics"])
    data = [m for topic, one in zip(topics, found, strict=True) if topic.startswith("DDATA") for m in one["metrics"]]
    assert {m["alias"] for m in data} == {device["pressure"]["alias"]}
    assert [told(m)[1:] for m in data[:3]] == [(5.0, False, 192), (None, False, 0), (3.0, True, 192)]
    runs = [k for k, topic in enumerate(topics) if topic.startswith("NBIRTH")]
    for begin, end in itertools.pairwise([*runs, len(topics)]):
        living = [
            one["seq"] for topic, one in zip(topics[begin:end], found[begin:end], strict=True) if "NDEATH" not in topic
        ]
        assert living == list(range(len(living)))


@needs_broker
def test_the_will_is_the_death_of_the_newest_birth_and_what_happened_meanwhile_follows(
    broker: Broker, tmp_path: Path
) -> None:
    folder_of("sparkplug-payload", "1.0.3")
    source, host = FakeSource(), Host(broker)

    async def story() -> None:
        source.reads(0.0, utc_s=1.79e9)
        async with at_once(host.run(), outlet_of(broker, source, tmp_path).run()):
            await until((tmp_path / "sparkplug.json").exists)
            await until(host.connected.is_set)
            broker.stop()
            await until(lambda: not host.connected.is_set())
            for k in range(1, 301):
                source.reads(float(k), utc_s=1.79e9 + 0.001 * k)
            broker.start()
            await until(lambda: json.loads((tmp_path / "sparkplug.json").read_text())["reading"] == 301)

    asyncio.run(story())
    found = decoded([payload for topic, payload in host.got if topic.startswith("DDATA")])
    values = [metric["value"] for one in found for metric in one["metrics"]]
    unique = list(dict.fromkeys(values))
    assert unique == sorted(unique)
    assert unique[-1] == 300.0


@needs_broker
def test_a_node_waits_for_its_primary_host_and_dies_when_it_goes(broker: Broker, tmp_path: Path) -> None:
    source, host = FakeSource(), Host(broker)

    async def story() -> None:
        async with at_once(host.run(), outlet_of(broker, source, tmp_path, primary_host="scada").run()):
            await until(host.connected.is_set)
            await host.says("spBv1.0/STATE/scada", b'{"online": false, "timestamp": 1}', retain=True)
            await host.says("spBv1.0/plant/NCMD/bench", REBIRTH)
            assert host.got == []
            await host.says("spBv1.0/STATE/scada", b'{"online": true, "timestamp": 2}', retain=True)
            await until(lambda: host.kinds() == ["NBIRTH", "DBIRTH"])
            await host.says("spBv1.0/STATE/scada", b'{"online": false, "timestamp": 3}', retain=True)
            await until(lambda: host.kinds() == ["NBIRTH", "DBIRTH", "NDEATH"])
            await host.says("spBv1.0/STATE/scada", b'{"online": true, "timestamp": 4}', retain=True)
            await until(lambda: host.kinds()[3:] == ["NBIRTH", "DBIRTH"])

    asyncio.run(story())


def test_every_type_of_value_survives_the_decoder_of_others() -> None:
    metrics = [
        Metric(name="d", alias=1, datatype=DOUBLE, value=-1.5e300, at_ms=1_790_000_000_123),
        Metric(
            name="i", alias=300, datatype=INT32, value=7, at_ms=1, properties={"low": -0.5, "many": 2**31 - 1, "é": "µ"}
        ),
        Metric(name="u", datatype=UINT64, value=255, at_ms=1, is_historical=True),
        Metric(name="b", datatype=BOOLEAN, value=True, at_ms=1),
        Metric(name="s", datatype=STRING, value="ä" * 200, at_ms=1),
        Metric(name="n", datatype=STRING, value=None, at_ms=1),
    ]
    (found,) = decoded([encoded(metrics, at_ms=1_790_000_000_456, seq=255)])
    assert (found["timestamp"], found["seq"]) == (1_790_000_000_456, 255)
    by_name = {metric["name"]: metric for metric in found["metrics"]}
    assert {name: metric["value"] for name, metric in by_name.items()} == {
        "d": -1.5e300, "i": 7, "u": 255, "b": True, "s": "ä" * 200, "n": None,
    }  # fmt: skip
    assert (by_name["d"]["timestamp"], by_name["i"]["alias"], by_name["u"]["isHistorical"]) == (
        1_790_000_000_123,
        300,
        True,
    )
    assert {key: one["value"] for key, one in by_name["i"]["properties"].items()} == {
        "low": -0.5,
        "many": 2**31 - 1,
        "é": "µ",
    }


@pytest.mark.parametrize("payload", [b"", b"\xff" * 40, REBIRTH[:-1], b"\x12\x7fab", b'{"online": true}', b"\x0b"])
def test_a_command_that_is_none_asks_for_nothing(payload: bytes) -> None:
    assert not asks_for_rebirth(payload)
    assert asks_for_rebirth(REBIRTH)
