"""Serves messages to Foxglove over a WebSocket, by Foxglove's own SDK (the extra `foxglove`)."""

from __future__ import annotations

import json
from types import ModuleType
from typing import Any

from google.protobuf.message import Message

from hal.errors import ConfigError
from service.recording.foxglove import schema_of


class LiveServer:
    """A WebSocket server on this machine; Foxglove connects to its `url`. Threads may share it.

    Args:
        port: 0 takes a free one.

    Raises:
        ConfigError: the SDK is not installed, or the port is in use.
    """

    def __init__(self, port: int) -> None:
        self._sdk = _sdk()
        self._context = self._sdk.Context()
        self._channels: dict[str, Any] = {}
        try:
            self._server = self._sdk.start_server(
                name="panelwright", host="127.0.0.1", port=port, context=self._context
            )
        except (OSError, RuntimeError) as error:
            hint = "another program uses the port: give another one with --port"
            raise ConfigError(f"the live view cannot listen on port {port}: {error}", hint=hint) from error

    @property
    def url(self) -> str:
        """Address for Foxglove's "Open connection"."""
        return f"ws://127.0.0.1:{self._server.port}"

    def show(self, topic: str, message: Message, *, time_ns: int) -> None:
        """Send a message in one of Foxglove's schemas to those who look at the topic."""
        channel = self._channels.get(topic)
        if channel is None:
            kind: Any = type(message)
            schema = self._sdk.Schema(name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=schema_of(kind))
            channel = self._channel(topic, schema, "protobuf")
        channel.log(message.SerializeToString(), log_time=time_ns)

    def show_json(self, topic: str, value: Any, *, time_ns: int) -> None:
        """Send plain JSON values, for plots and raw messages."""
        channel = self._channels.get(topic) or self._channel(topic, None, "json")
        channel.log(json.dumps(value).encode(), log_time=time_ns)

    def close(self) -> None:
        """End the server."""
        self._server.stop()

    def _channel(self, topic: str, schema: Any, encoding: str) -> Any:
        channel = self._sdk.Channel(topic, schema=schema, message_encoding=encoding, context=self._context)
        return self._channels.setdefault(topic, channel)


def _sdk() -> ModuleType:
    try:
        import foxglove
    except ModuleNotFoundError as error:
        raise ConfigError(
            "the live view needs the Python package foxglove-sdk", hint="pip install 'panelwright[foxglove]'"
        ) from error
    return foxglove
