"""OPC UA: a server whose address space is the panel, with values, units, quality and time stamps, and alarms as conditions.

Objects/CELL                  ServiceAnswers
Objects/CELL/NAME             Value (with EURange and EngineeringUnits) or State, Sigma, Confidence, Cause
Objects/CELL/NAME/KIND        an alarm: an instance of AlarmConditionType, and State
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole

from hal.errors import CellError
from hal.outlets import OpcuaSection
from service.outlets.deliver import Backoff, Sleep, batches
from service.outlets.opcua_alarms import Conditions
from service.outlets.opcua_nodes import ObjectNode, add_node
from service.outlets.opcua_trust import TrustedClients
from service.outlets.source import Deed, Instrument, Memory, Source

NAMESPACE = "urn:panelwright:{cell}"
ENCRYPTED = (
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
)
T = TypeVar("T")
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Users:
    """Who may log in: anybody, or one user with a password. Nobody may change the address space."""

    username: str | None = None
    password: str | None = None

    def get_user(self, _server: Any, username: str | None = None, password: str | None = None, **_: Any) -> User | None:
        """Return the user of a session; None refuses it."""
        if self.username is None or (username, password) == (self.username, self.password):
            return User(role=UserRole.User, name=username)
        return None


class OpcuaOutlet:
    """Serves the state of a cell over OPC UA.

    Args:
        password: of `section.username`.
        sleep: waits between tries.
    """

    def __init__(
        self,
        section: OpcuaSection,
        *,
        cell: str,
        source: Source,
        password: str | None = None,
        sleep: Sleep = asyncio.sleep,
    ) -> None:
        self._section, self._cell, self._source, self._sleep = section, cell, source, sleep
        self._password = password
        self._objects: dict[str, ObjectNode] = {}
        self._instruments: dict[str, Instrument] = {}

    async def run(self) -> None:
        """Serve for ever."""
        instruments = await self._asked(self._source.panel)
        server = await self._built(instruments)
        await self._wait_for_port()
        await server.start()
        log.info("OPC UA: serves opc.tcp://%s:%d/panelwright", self._section.host, self._section.port)
        try:
            await self._follow()
        finally:
            await server.stop()

    async def _built(self, instruments: tuple[Instrument, ...]) -> Server:
        logging.getLogger("asyncua").setLevel(logging.ERROR)  # its warnings are about each session without encryption
        section, uri = self._section, NAMESPACE.format(cell=self._cell)
        server = Server(user_manager=Users(section.username, self._password))
        server.iserver.bind_condition_methods = 1  # asyncua answers ConditionRefresh
        await server.init()
        server.set_endpoint(f"opc.tcp://{section.host}:{section.port}/panelwright")
        server.set_server_name(f"panelwright {self._cell}")
        await server.set_application_uri(uri)
        tokens: list[type] = [ua.AnonymousIdentityToken] if section.username is None else [ua.UserNameIdentityToken]
        server.set_identity_tokens(tokens)
        if section.certificate_file is None or section.private_key_file is None:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        else:
            server.set_security_policy(list(ENCRYPTED))
            await server.load_certificate(section.certificate_file)
            await server.load_private_key(Path(section.private_key_file))
            trusted = None if section.trusted_clients is None else Path(section.trusted_clients)
            server.set_certificate_validator(TrustedClients(trusted).validate)
        index = await server.register_namespace(f"{uri}:panel")
        root = await server.nodes.objects.add_object(ua.NodeId(self._cell, index), ua.QualifiedName(self._cell, index))
        self._answers = await add_node(root, "ServiceAnswers", path="ServiceAnswers", variable=ua.VariantType.Boolean)
        for one in instruments:
            self._instruments[one.name] = one
            self._objects[one.name] = await ObjectNode.added(server, root, one)
        self._conditions = Conditions(server, act=self._act if section.acknowledge else None)
        await self._conditions.start()
        return server

    async def _wait_for_port(self) -> None:
        """Wait until no other program has the port."""
        host, port, backoff = self._section.host, self._section.port, Backoff(self._sleep)
        while True:
            try:
                socket.create_server((host, port)).close()
            except OSError as error:
                log.warning("OPC UA: %s:%d: %s", host, port, error)
                await backoff.pause()
            else:
                return

    async def _follow(self) -> None:
        async def on_silence(is_silent: bool) -> None:
            await self._answers.write_value(not is_silent)
            if is_silent:
                for one in self._objects.values():
                    await one.tell_nothing(ua.StatusCodes.BadNoCommunication)
            else:
                state = await self._asked(self._source.state)
                await self._tell(state.readings.values(), state.alarms.values())

        kept, begins = Memory(), True
        async for found in batches(self._source, kept, on_silence=on_silence, sleep=self._sleep):
            if begins:
                await on_silence(False)
                begins = False
            await self._tell(found.readings, found.alarms)

    async def _asked(self, question: Callable[[], Awaitable[T]]) -> T:
        """Return the service's answer, however long it is silent."""
        backoff = Backoff(self._sleep)
        while True:
            try:
                return await question()
            except CellError as error:
                log.warning("OPC UA: %s", error.what)
                await backoff.pause()

    async def _tell(self, readings: Iterable[Mapping[str, Any]], alarms: Iterable[Mapping[str, Any]]) -> None:
        for reading in readings:
            if reading["object"] in self._objects:
                await self._objects[reading["object"]].tell(reading)
        for alarm in alarms:
            name = alarm["object"]
            if name in self._objects:
                await self._conditions.tell(alarm, self._objects[name].node, self._instruments[name].priority)

    async def _act(self, alarm: str, deed: Deed, comment: str) -> None:
        await self._source.act(alarm, deed, by=f"{self._section.username} (OPC UA)", reason=comment)
