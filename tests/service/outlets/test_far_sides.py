"""Other people's programs on the far side: Mosquitto's clients over TLS, and promtool; and a broker that is away for a day."""

from __future__ import annotations

import asyncio
import datetime
import functools
import ipaddress
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from prometheus_client import CollectorRegistry, generate_latest

from hal.outlets import MqttSection, PrometheusSection
from service.outlets.mqtt import MqttOutlet
from service.outlets.prometheus import PrometheusOutlet
from service.outlets.source import Cursor, CursorFile
from tests.service.outlets.fakes import FakeSource, no_pause
from tests.service.outlets.test_mqtt import MOSQUITTO, Broker, at_once, broker, until

SUBSCRIBER = shutil.which("mosquitto_sub")
PROMTOOL = shutil.which("promtool") or shutil.which(
    "promtool", path=str(Path(__file__).parents[3] / ".venv" / "prometheus")
)
DAY_S = 86_400
assert broker  # the fixture


def certificate(folder: Path) -> tuple[Path, Path]:
    """Write a certificate of 127.0.0.1 that signs itself, and its key."""
    key, name = (
        ec.generate_private_key(ec.SECP256R1()),
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "127.0.0.1")]),
    )
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    (folder / "cert.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return folder / "cert.pem", folder / "key.pem"


async def subscribed(topic: str, count: int, *, port: int, cert: Path) -> list[Any]:
    """Return topic, whether it was retained, and content of so many messages, as mosquitto_sub prints them."""
    command = [
        str(SUBSCRIBER), "-h", "127.0.0.1", "-p", str(port), "--cafile", str(cert), "-t", topic, "-C", str(count),
        "-W", "30", "-F", "%t %r %p",
    ]  # fmt: skip
    client = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, errors = await client.communicate()
    assert client.returncode == 0, errors.decode()
    rows = [line.split(" ", 2) for line in out.decode().splitlines()]
    return [(where, kept == "1", json.loads(text)) for where, kept, text in rows]


@pytest.mark.skipif(MOSQUITTO is None, reason="Mosquitto is not installed (apt-get install mosquitto)")
@pytest.mark.skipif(SUBSCRIBER is None, reason="its clients are not installed (apt-get install mosquitto-clients)")
@pytest.mark.third_party("mosquitto-clients", [])
def test_mosquitto_sub_reads_values_alarms_and_the_will_over_tls(tmp_path: Path, broker: Broker) -> None:
    broker.stop()
    cert, key = certificate(tmp_path)
    config = tmp_path / "mosquitto.conf"
    config.write_text(
        f"listener {broker.port} 127.0.0.1\nallow_anonymous true\ncertfile {cert}\nkeyfile {key}\nuser root\n"
    )
    secure = subprocess.Popen([str(MOSQUITTO), "-c", str(config)], stderr=subprocess.DEVNULL)

    read = functools.partial(subscribed, port=broker.port, cert=cert)

    async def story() -> None:
        source = FakeSource()
        section = MqttSection(host="127.0.0.1", port=broker.port, tls=True, ca_file=str(cert))
        untrusting = section.model_copy(update={"ca_file": None})
        kept = CursorFile(tmp_path / "mqtt.json")
        stranger = MqttOutlet(
            untrusting, cell="stranger", source=source, cursor=CursorFile(tmp_path / "x"), sleep=no_pause
        )
        outlet = MqttOutlet(section, cell="bench", source=source, cursor=kept, sleep=no_pause)
        async with at_once(outlet.run(), stranger.run()):
            await until((tmp_path / "mqtt.json").exists)
            source.reads(4.5)
            source.alarms_change()
            await until(lambda: kept.load() == Cursor(reading=1, alarm=1))
            ((where, is_kept, told),) = await read("panelwright/bench/objects/+", 1)
            assert (where, is_kept, told["value"], told["unit"]) == (
                "panelwright/bench/objects/pressure",
                True,
                4.5,
                "bar",
            )
            ((_where, _kept, alarm),) = await read("panelwright/bench/alarms/#", 1)
            assert alarm["state"] == "unacknowledged"
            ((_where, _kept, status),) = await read("panelwright/bench/status", 1)
            assert status == {"state": "online"}
            assert not (tmp_path / "x").exists(), "a broker whose certificate nobody trusts is told nothing"
        async with at_once(MqttOutlet(section, cell="bench", source=source, cursor=kept, sleep=no_pause).run()):
            while_it_lives = asyncio.ensure_future(read("panelwright/bench/status", 2))
            await asyncio.sleep(0)
            # The same identifier again: the broker breaks the older connection, which is when it tells a will.
            while not while_it_lives.done():
                with_same = aiomqtt.Client(
                    "127.0.0.1", broker.port, identifier="panelwright-bench",
                    tls_params=aiomqtt.TLSParameters(ca_certs=str(cert)),
                )  # fmt: skip
                async with with_same:
                    await no_pause(0.0)
            assert {"state": "offline"} in [one for _where, _kept, one in await while_it_lives]

    try:
        asyncio.run(story())
    finally:
        secure.kill()
        secure.wait()


@pytest.mark.skipif(MOSQUITTO is None, reason="Mosquitto is not installed (apt-get install mosquitto)")
def test_of_a_day_without_a_broker_nothing_is_lost_doubled_or_out_of_order(broker: Broker, tmp_path: Path) -> None:
    got: list[int] = []

    async def story() -> None:
        source, kept, now_s = FakeSource(batch=200), CursorFile(tmp_path / "mqtt.json"), 0.0
        broker_is_due, is_heard = asyncio.Event(), asyncio.Event()

        async def sleep(seconds: float) -> None:  # the simulated clock: each pause of the outlet is a part of the day
            nonlocal now_s
            before, now_s = now_s, now_s + seconds
            for k in range(int(before // 60), min(int(now_s // 60), DAY_S // 60)):
                source.reads(float(k), utc_s=1.79e9 + 60.0 * k, object=f"object_{k % 20}")
            if now_s >= DAY_S and not broker_is_due.is_set():
                broker.start()
                broker_is_due.set()
                await is_heard.wait()  # else the first messages come before their listener
            await asyncio.sleep(0.0)

        outlet = MqttOutlet(
            MqttSection(host="127.0.0.1", port=broker.port), cell="bench", source=source, cursor=kept, sleep=sleep
        )
        kept.save(Cursor(reading=0, alarm=0))
        broker.stop()

        async def listen() -> None:
            await broker_is_due.wait()
            while True:
                try:
                    async with aiomqtt.Client("127.0.0.1", broker.port) as client:
                        await client.subscribe("panelwright/+/objects/+", qos=1)
                        is_heard.set()
                        async for message in client.messages:
                            if not message.retain:
                                got.append(json.loads(bytes(message.payload))["id"])  # type: ignore[arg-type]
                except aiomqtt.MqttError:
                    await asyncio.sleep(0.01)

        async with at_once(listen(), outlet.run()):
            await until(lambda: kept.load().reading == DAY_S // 60)
            await until(lambda: bool(got) and got[-1] == DAY_S // 60)

    asyncio.run(story())
    lost, doubled = DAY_S // 60 - len(set(got)), len(got) - len(set(got))
    assert (lost, doubled, got == sorted(got)) == (0, 0, True)


@pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed (Debian's package prometheus; see .ci/run)")
@pytest.mark.third_party("promtool", [])
def test_promtool_finds_no_fault_in_the_metrics() -> None:
    source = FakeSource()
    source.reads(4.5)
    source.reads(None, object="flow")
    source.reads(None, object="pump_lamp", state='o"n\\', quality="valid")
    source.alarms_change()
    outlet = PrometheusOutlet(PrometheusSection(), cell="bench", source=source)
    registry = CollectorRegistry()
    registry.register(outlet)
    for is_silent in (False, True):
        source.is_silent = is_silent
        asyncio.run(outlet.refresh())
        done = subprocess.run(
            [str(PROMTOOL), "check", "metrics"], input=generate_latest(registry), capture_output=True, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
