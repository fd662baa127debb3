"""Sections of the cell file about what the gateway tells other programs of the plant."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.panel.turn import meant_otherwise
from hal.strict import Strict

Port = Annotated[int, Field(ge=1, le=65535)]
Host = Annotated[str, Field(min_length=1, max_length=253)]
TopicLevel = Annotated[str, Field(pattern=r"^[^/+#\x00-\x1f]{1,100}$")]


class BrokerSection(Strict):
    """Where an MQTT broker is, and how to log in."""

    host: Host
    port: Port = 1883
    username: str | None = None
    password_file: Annotated[str | None, Field(description="file with the password, which only its owner may read")] = (
        None
    )
    tls: Annotated[bool, Field(description="encrypt, and check the broker's certificate")] = False
    ca_file: Annotated[str | None, Field(description="certificate to trust, instead of the system's; with tls")] = None


class MqttSection(BrokerSection):
    """`[outlets.mqtt]`: readings and alarms as retained messages of a broker."""

    topic: Annotated[TopicLevel, Field(description="first level of all topics")] = "panelwright"


class SparkplugSection(BrokerSection):
    """`[outlets.sparkplug]`: the cell as an edge node of Sparkplug B, with its panel as the device."""

    group: Annotated[TopicLevel, Field(description="id of the group, the second level of all topics")]
    primary_host: Annotated[
        TopicLevel | None, Field(description="id of the host application; while it is offline the node waits")
    ] = None


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


class OpcuaSection(Strict):
    """`[outlets.opcua]`: a server with an object for each object of the panel, and its alarms as conditions."""

    port: Port = 4840
    host: Host = "127.0.0.1"
    username: Annotated[str | None, Field(min_length=1, description="with it, clients must log in")] = None
    password_file: Annotated[str | None, Field(description="file with the password, which only its owner may read")] = (
        None
    )
    certificate_file: Annotated[
        str | None, Field(description="PEM; with it, only signed and encrypted connections are taken")
    ] = None
    private_key_file: Annotated[str | None, Field(description="PEM, which only its owner may read")] = None
    trusted_clients: Annotated[
        str | None,
        Field(
            description="folder with certificates (PEM or DER) of the clients that may connect, or of their authorities"
        ),
    ] = None
    acknowledge: Annotated[
        bool, Field(description="clients may acknowledge alarms and comment on them; nothing else can be called")
    ] = False
    key_file: Annotated[
        str | None, Field(description="file with an operator's key, by which alarms are acknowledged")
    ] = None

    @model_validator(mode="after")
    def _is_whole(self) -> OpcuaSection:
        if (self.username is None) != (self.password_file is None):
            raise ValueError("username and password_file go together: give both or none")
        if (self.certificate_file is None) != (self.private_key_file is None):
            raise ValueError("certificate_file and private_key_file go together: give both or none")
        if self.trusted_clients is not None and self.certificate_file is None:
            raise ValueError("trusted_clients needs certificate_file: a client shows its certificate only if encrypted")
        if self.acknowledge and self.username is None:
            raise ValueError("acknowledge needs username and password_file: else anybody could acknowledge alarms")
        if self.key_file is not None and not self.acknowledge:
            raise ValueError("key_file is of use only with acknowledge = true")
        return self


class OutletsSection(Strict):
    """`[outlets]`: what the gateway tells; without any of these there is no gateway."""

    mqtt: MqttSection | None = None
    webhook: WebhookSection | None = None
    prometheus: PrometheusSection | None = None
    opcua: OpcuaSection | None = None
    sparkplug: SparkplugSection | None = None

    @model_validator(mode="after")
    def _listen_at_different_ports(self) -> OutletsSection:
        if self.prometheus is not None and self.opcua is not None and self.prometheus.port == self.opcua.port:
            told = f"prometheus and opcua both listen at port {self.opcua.port}"
            raise meant_otherwise(told, "give each a port of its own")
        return self

    @property
    def is_empty(self) -> bool:
        """Whether nobody is told anything."""
        return self == OutletsSection()
