"""Tests of the OPC UA outlet on the loop-back: values, units, quality, time stamps, alarms, and what clients may not do."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, Node, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

from hal.outlets import OpcuaSection
from service.outlets.opcua import NAMESPACE, OpcuaOutlet
from service.outlets.opcua_nodes import CODES, UNECE, unit_of
from tests.service.outlets.fakes import FakeSource, no_pause
from tests.service.outlets.node_packages import NODE, folder_of

AT_S = 1.79e9
USER = {"username": "scada", "password_file": "unused"}  # of a test


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextlib.asynccontextmanager
async def serving(source: FakeSource, **given: Any) -> AsyncIterator[str]:
    """Run the outlet; yields its address."""
    section = OpcuaSection(port=free_port(), **given)
    outlet = OpcuaOutlet(section, cell="bench", source=source, password="s3cret", sleep=no_pause)  # noqa: S106 - of a test
    task = asyncio.ensure_future(outlet.run())
    try:
        async with asyncio.timeout(60.0):
            while not task.done():
                with contextlib.suppress(OSError):
                    (await asyncio.open_connection("127.0.0.1", section.port))[1].close()
                    break
                await asyncio.sleep(0.02)
        if task.done():
            await task
        yield f"opc.tcp://127.0.0.1:{section.port}/panelwright"
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.asynccontextmanager
async def connected(url: str, **login: str) -> AsyncIterator[Client]:
    """Connect a client."""
    client = Client(url)
    if login:
        client.set_user(login["username"])
        client.set_password(login["password"])
    async with client:
        yield client


async def node_of(client: Client, path: str) -> Node:
    index = await client.get_namespace_index(NAMESPACE.format(cell="bench") + ":panel")
    return client.get_node(ua.NodeId(path, index))


async def until(client: Client, path: str, holds: Callable[[ua.DataValue], bool]) -> ua.DataValue:
    """Read a variable until what it tells holds."""
    node = await node_of(client, path)
    async with asyncio.timeout(30.0):
        while True:
            found = await node.read_data_value(raise_on_bad_status=False)
            if holds(found):
                return found
            await asyncio.sleep(0.01)


def is_status(status: int) -> Callable[[ua.DataValue], bool]:
    return lambda found: found.StatusCode.value == status


def test_a_reading_has_value_unit_range_quality_and_its_own_time() -> None:
    async def story() -> None:
        source = FakeSource()
        source.reads(4.5)
        async with serving(source) as url, connected(url) as client:
            found = await until(client, "pressure.value", is_status(ua.StatusCodes.Good))
            assert (found.Value.Value, found.SourceTimestamp) == (4.5, datetime.fromtimestamp(AT_S, UTC))
            value = await node_of(client, "pressure.value")
            assert (await value.read_type_definition()).Identifier == ua.ObjectIds.AnalogItemType
            limits = await (await value.get_child("0:EURange")).read_value()
            unit = await (await value.get_child("0:EngineeringUnits")).read_value()
            assert (limits.Low, limits.High) == (0.0, 10.0)
            assert (unit.NamespaceUri, unit.UnitId, unit.DisplayName.Text) == (UNECE, 4342098, "bar")
            empty = await until(client, "temperature.value", lambda _found: True)
            assert empty.StatusCode.value == ua.StatusCodes.BadWaitingForInitialData
            source.reads(5.0, utc_s=AT_S + 10, sure=False)
            unsure = await until(client, "pressure.value", is_status(ua.StatusCodes.Uncertain))
            assert unsure.Value.Value == 5.0
            source.reads(None, utc_s=AT_S + 20)
            refused = await until(client, "pressure.value", is_status(ua.StatusCodes.Bad))
            assert refused.Value.Value is None, "the last good value is never told again"
            assert (await until(client, "pressure.cause", lambda _found: True)).Value.Value == "glare"
            source.reads(9.0, utc_s=AT_S + 5)  # older than what is shown
            source.reads(None, object="pump_lamp", state="on", quality="valid", cause="", utc_s=AT_S)
            lamp = await until(client, "pump_lamp.state", is_status(ua.StatusCodes.Good))
            assert lamp.Value.Value == "on"
            assert (await until(client, "pressure.value", lambda _found: True)).StatusCode.value == ua.StatusCodes.Bad

    asyncio.run(story())


def test_a_silent_service_leaves_no_value_and_the_state_returns_with_it() -> None:
    async def story() -> None:
        source = FakeSource()
        source.reads(4.5)
        async with serving(source) as url, connected(url) as client:
            await until(client, "pressure.value", is_status(ua.StatusCodes.Good))
            source.is_silent = True
            source.reads(4.5)  # ends the wait
            lost = await until(client, "pressure.value", is_status(ua.StatusCodes.BadNoCommunication))
            assert lost.Value.Value is None
            assert (await until(client, "ServiceAnswers", lambda _found: True)).Value.Value is False
            source.is_silent = False
            await until(client, "pressure.value", is_status(ua.StatusCodes.Good))
            assert (await until(client, "ServiceAnswers", lambda _found: True)).Value.Value is True

    asyncio.run(story())


class Events:
    """What a subscription to events has got."""

    def __init__(self) -> None:
        self.got: asyncio.Queue[Any] = asyncio.Queue()

    def event_notification(self, event: Any) -> None:
        self.got.put_nowait(event)

    async def next(self) -> Any:
        async with asyncio.timeout(30.0):
            while True:
                event = await self.got.get()
                if getattr(event, "ConditionName", None) is not None:
                    return event


async def listening(client: Client) -> tuple[Events, Any]:
    events = Events()
    subscription = await client.create_subscription(20, events)
    await subscription.subscribe_alarms_and_conditions(client.nodes.server, [ua.ObjectIds.AlarmConditionType])
    return events, subscription


def shown(event: Any) -> tuple[Any, ...]:
    return (
        event.ConditionName,
        getattr(event, "ActiveState/Id"),
        getattr(event, "AckedState/Id"),
        event.Retain,
        event.Severity,
    )


def test_alarms_are_conditions_that_can_be_refreshed_and_acknowledged_only_if_the_file_allows() -> None:
    async def story() -> None:
        source = FakeSource()
        source.alarms_change()
        async with (
            serving(source, acknowledge=True, **USER) as url,
            connected(url, username="scada", password="s3cret") as client,  # noqa: S106 - of a test
        ):
            await until(client, "pressure.high.State", lambda found: found.Value.Value == "unacknowledged")
            events, subscription = await listening(client)
            condition_type = client.get_node(ua.ObjectIds.ConditionType)
            refresh = ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh)
            number = ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)
            await condition_type.call_method(refresh, number)
            risen = await events.next()
            assert shown(risen) == ("pressure.high", True, False, True, 700)
            assert risen.Message.Text == "pressure is 7 bar, above 6"

            condition = await node_of(client, "pressure.high")
            acknowledge = ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
            comment = ua.LocalizedText("on my way")
            with pytest.raises(ua.UaStatusCodeError) as caught:
                await condition.call_method(acknowledge, b"of another state", comment)
            assert caught.value.code == ua.StatusCodes.BadEventIdUnknown
            assert source.acts == []
            await condition.call_method(acknowledge, risen.EventId, comment)
            assert source.acts == [("pressure.high", "acknowledge", "scada (OPC UA)", "on my way")]
            seen = await events.next()
            assert shown(seen) == ("pressure.high", True, True, True, 700)
            add_comment = ua.NodeId(ua.ObjectIds.ConditionType_AddComment)
            with pytest.raises(ua.UaStatusCodeError) as caught:
                await condition.call_method(add_comment, risen.EventId, ua.LocalizedText("of an older state"))
            assert caught.value.code == ua.StatusCodes.BadEventIdUnknown
            with pytest.raises(ua.UaStatusCodeError) as caught:
                await condition.call_method(add_comment, seen.EventId, ua.LocalizedText(""))
            assert caught.value.code == ua.StatusCodes.BadInvalidArgument
            await condition.call_method(add_comment, seen.EventId, ua.LocalizedText("the valve sticks"))
            assert source.acts[1:] == [("pressure.high", "comment", "scada (OPC UA)", "the valve sticks")]
            commented = await events.next()
            assert shown(commented) == ("pressure.high", True, True, True, 700)
            assert (commented.Comment.Text, commented.ClientUserId) == ("the valve sticks", "scada (OPC UA)")
            source.alarms_change(state="normal", is_active=False, changed_s=AT_S + 60)
            assert shown(await events.next()) == ("pressure.high", False, True, False, 700)
        assert len(source.acts) == 2
        async with serving(source) as url, connected(url) as client:
            await until(client, "pressure.high.State", lambda found: found.Value.Value == "normal")
            condition = await node_of(client, "pressure.high")
            for method in (acknowledge, add_comment):
                with pytest.raises(ua.UaStatusCodeError):
                    await condition.call_method(method, b"x", comment)

    asyncio.run(story())


def test_each_alarm_is_an_instance_of_the_standard_type_that_holds_its_newest_state() -> None:
    async def story() -> None:
        source = FakeSource()
        source.alarms_change()
        async with serving(source) as url, connected(url) as client:
            await until(client, "pressure.high.State", lambda found: found.Value.Value == "unacknowledged")
            condition = await node_of(client, "pressure.high")
            assert (await condition.read_type_definition()).Identifier == ua.ObjectIds.AlarmConditionType
            (owner,) = await condition.get_referenced_nodes(ua.ObjectIds.HasCondition, ua.BrowseDirection.Inverse)
            assert owner == await node_of(client, "pressure")

            async def part(path: str) -> Any:
                return await (await condition.get_child([f"0:{one}" for one in path.split("/")])).read_value()

            assert [await part(f"{one}/Id") for one in ("EnabledState", "ActiveState", "AckedState")] == [
                True,
                True,
                False,
            ]
            assert ((await part("AckedState")).Text, (await part("ActiveState")).Text) == ("Unacknowledged", "Active")
            assert (await part("Severity"), await part("Retain"), await part("SourceName")) == (700, True, "pressure")
            assert (await part("Message")).Text == "pressure is 7 bar, above 6"
            assert (await part("Comment/SourceTimestamp")) == await part("Time") == datetime.fromtimestamp(AT_S, UTC)
            assert len(await part("EventId")) == 16
            methods = await condition.get_referenced_nodes(ua.ObjectIds.HasComponent, nodeclassmask=ua.NodeClass.Method)
            assert methods == [], "what the file does not allow is not offered"
            source.alarms_change(state="shelved", by="alice", reason="test run", changed_s=AT_S + 60)
            await until(client, "pressure.high.State", lambda found: found.Value.Value == "shelved")
            assert ((await part("Comment")).Text, await part("ClientUserId")) == ("test run", "alice")
            assert [await part(one) for one in ("AckedState/Id", "SuppressedOrShelved", "Retain")] == [True, True, True]
            source.alarms_change(state="normal", is_active=False, changed_s=AT_S + 120)
            await until(client, "pressure.high.State", lambda found: found.Value.Value == "normal")
            assert [await part(one) for one in ("ActiveState/Id", "Retain", "Severity")] == [False, False, 700]

    asyncio.run(story())


def test_clients_may_only_look() -> None:
    async def story() -> None:
        source = FakeSource()
        source.reads(4.5)
        async with serving(source) as url, connected(url) as client:
            await until(client, "pressure.value", is_status(ua.StatusCodes.Good))
            value = await node_of(client, "pressure.value")
            with pytest.raises(ua.UaStatusCodeError):
                await value.write_value(99.0)
            with pytest.raises(ua.UaStatusCodeError):
                await client.nodes.objects.add_object(2, "mine")
            with pytest.raises(ua.UaStatusCodeError):
                await client.delete_nodes([value])
            assert (await value.read_value()) == 4.5
        async with serving(source, **USER) as url:
            for login in ({}, {"username": "scada", "password": "wrong"}, {"username": "other", "password": "s3cret"}):
                with pytest.raises(ua.UaStatusCodeError):
                    async with connected(url, **login):
                        pass

    asyncio.run(story())


def test_with_a_certificate_only_encrypted_connections_are_taken(tmp_path: Path) -> None:
    cert, key = rsa_certificate(tmp_path)

    async def story() -> None:
        source = FakeSource()
        source.reads(4.5)
        async with serving(source, certificate_file=str(cert), private_key_file=str(key), **USER) as url:
            plain = Client(url)
            plain.set_user("scada")
            plain.set_password("s3cret")
            with pytest.raises((ua.UaError, OSError)):
                async with plain:
                    pass
            client = Client(url)
            client.application_uri = NAMESPACE.format(cell="bench")
            client.set_user("scada")
            client.set_password("s3cret")
            await client.set_security(SecurityPolicyBasic256Sha256, str(cert), str(key), server_certificate=str(cert))
            async with client:
                await until(client, "pressure.value", is_status(ua.StatusCodes.Good))

    asyncio.run(story())


def rsa_certificate(folder: Path) -> tuple[Path, Path]:
    """Write a certificate with the server's application URI, and its key."""
    key, name = (
        rsa.generate_private_key(public_exponent=65537, key_size=2048),
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "bench")]),
    )
    now = datetime.now(UTC)
    uri = x509.UniformResourceIdentifier(NAMESPACE.format(cell="bench"))
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([uri]), critical=False)
        .sign(key, hashes.SHA256())
    )
    (folder / "cert.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return folder / "cert.pem", folder / "key.pem"


def test_units_have_the_numbers_that_unece_gives_them() -> None:
    assert unit_of("bar").UnitId == int.from_bytes(b"BAR", "big")
    assert unit_of("°C").UnitId == 4408652, "the example of OPC 10000-8"
    assert unit_of("furlong").UnitId == -1
    assert all(2 <= len(code) <= 3 for code in CODES.values())


def test_without_the_section_the_library_is_not_imported() -> None:
    code = (
        "import sys, pathlib; import service.outlets.process, service.commissioning.outlets; from hal.outlets import *; "
        "print('asyncua' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


SCRIPT = Path(__file__).with_name("opcua_client.js")


@pytest.mark.third_party("node-opcua", [])
def test_node_opcua_reads_the_same_and_gets_the_alarm(tmp_path: Path) -> None:
    packages = folder_of("node-opcua-client", "2.186.4")

    async def story() -> dict[str, Any]:
        source = FakeSource()
        source.reads(4.5)
        source.reads(None, object="temperature")
        async with serving(source, acknowledge=True, **USER) as url:
            async with connected(url, username="scada", password="s3cret") as client:  # noqa: S106 - of a test
                await until(client, "pressure.value", is_status(ua.StatusCodes.Good))
            other = await asyncio.create_subprocess_exec(
                str(NODE), str(SCRIPT), url, "scada", "s3cret",
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, cwd=tmp_path,
                env={**os.environ, "NODE_PATH": str(packages / "node_modules"), "HOME": str(tmp_path)},
            )  # fmt: skip
            assert other.stdout is not None and other.stderr is not None
            async with asyncio.timeout(90.0):
                assert (await other.stdout.readline()).strip() == b"listening", (await other.stderr.read()).decode()
                source.alarms_change()
                out, errors = await other.communicate()
            assert other.returncode == 0, errors.decode()
            assert source.acts == [
                ("pressure.high", "acknowledge", "scada (OPC UA)", "seen by node-opcua"),
                ("pressure.high", "comment", "scada (OPC UA)", "said by node-opcua"),
            ]
            return dict(json.loads(out))

    told = asyncio.run(story())
    assert told["value"] == {"value": 4.5, "status": "Good", "at": AT_S * 1000}
    assert told["refused"] == {"value": None, "status": "Bad"}
    assert (told["unit"], told["range"]) == ("bar", [0, 10])
    assert told["event"] == {
        "name": "pressure.high", "message": "pressure is 7 bar, above 6", "severity": 700, "active": True, "acknowledged": False,
    }  # fmt: skip
    assert told["after"] == {"active": True, "acknowledged": True}
