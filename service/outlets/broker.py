"""The connection to an MQTT broker."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable
from typing import TypeVar

import aiomqtt

from hal.outlets import BrokerSection

KEEPALIVE_S = 20
T = TypeVar("T")


class BrokerClient(aiomqtt.Client):
    """A client that ends when it is cancelled.

    aiomqtt waits by `asyncio.wait_for`, which in Python 3.11 loses a cancellation that comes together with the answer that it
    waits for. An outlet that publishes all the time would then go on for ever.
    """

    async def _wait_for(self, fut: Awaitable[T], timeout: float | None) -> T:  # noqa: ASYNC109 - as in aiomqtt
        try:
            async with asyncio.timeout(self.timeout if timeout is None else timeout):
                return await fut
        except TimeoutError as error:
            raise aiomqtt.MqttError("the broker did not answer in time") from error


def client_of(section: BrokerSection, identifier: str, will: aiomqtt.Will, password: str | None) -> BrokerClient:
    """Return a client that is not connected yet.

    Args:
        identifier: of the client; the broker ends an older connection with the same one.
        will: what the broker tells if the connection breaks.
        password: of the section's user.
    """
    return BrokerClient(
        section.host,
        section.port,
        username=section.username,
        password=password,
        identifier=identifier,
        will=will,
        tls_context=ssl.create_default_context(cafile=section.ca_file) if section.tls else None,
        keepalive=KEEPALIVE_S,
    )
