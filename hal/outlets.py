"""Sections of the cell file about what the gateway tells other programs of the plant."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from hal.strict import Strict

Port = Annotated[int, Field(ge=1, le=65535)]
Host = Annotated[str, Field(min_length=1, max_length=253)]
TopicLevel = Annotated[str, Field(pattern=r"^[^/+#\x00-\x1f]{1,100}$")]


class MqttSection(Strict):
    """`[outlets.mqtt]`: readings and alarms as retained messages of a broker."""

    host: Host
    port: Port = 1883
    topic: Annotated[TopicLevel, Field(description="first level of all topics")] = "panelwright"
    username: str | None = None
    password_file: Annotated[str | None, Field(description="file with the password, which only its owner may read")] = (
        None
    )
    tls: Annotated[bool, Field(description="encrypt, and check the broker's certificate")] = False
    ca_file: Annotated[str | None, Field(description="certificate to trust, instead of the system's; with tls")] = None


class WebhookSection(Strict):
    """`[outlets.webhook]`: changes of alarms, and readings if wanted, as signed requests."""

    url: Annotated[str, Field(pattern=r"^https?://\S+$", max_length=500)]
    secret_file: Annotated[str, Field(description="file with the secret that signs, which only its owner may read")]
    events: Annotated[tuple[Literal["alarms", "readings"], ...], Field(min_length=1)] = ("alarms",)
    tries: Annotated[int, Field(ge=1, le=100, description="of one request, before it becomes a dead letter")] = 10


class PrometheusSection(Strict):
    """`[outlets.prometheus]`: the newest readings and the alarms as metrics."""

    port: Port = 9464
    host: Host = "127.0.0.1"


class OutletsSection(Strict):
    """`[outlets]`: what the gateway tells; without any of these there is no gateway."""

    mqtt: MqttSection | None = None
    webhook: WebhookSection | None = None
    prometheus: PrometheusSection | None = None

    @property
    def is_empty(self) -> bool:
        """Whether nobody is told anything."""
        return self == OutletsSection()
