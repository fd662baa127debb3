"""The connection to an MQTT broker."""

from __future__ import annotations

import ssl

import aiomqtt

from hal.outlets import BrokerSection

KEEPALIVE_S = 20


def client_of(section: BrokerSection, identifier: str, will: aiomqtt.Will, password: str | None) -> aiomqtt.Client:
    """Return a client that is not connected yet.

    Args:
        identifier: of the client; the broker ends an older connection with the same one.
        will: what the broker tells if the connection breaks.
        password: of the section's user.
    """
    return aiomqtt.Client(
        section.host,
        section.port,
        username=section.username,
        password=password,
        identifier=identifier,
        will=will,
        tls_context=ssl.create_default_context(cafile=section.ca_file) if section.tls else None,
        keepalive=KEEPALIVE_S,
    )
