"""Emulated rosbridge (WebSocket, protocol 2.0) with ROS 2 nodes behind it, over any arm, gripper or force/torque sensor."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Field
from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, TcpPort
from drivers.emulators.ros2_nodes import ArmNode, ForceTorqueNode, GripperNode, Message, Node
from hal.devices import Arm, Device, ForceTorque, Gripper
from hal.errors import Unsupported
from hal.strict import validate


class Ros2EmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    rate_hz: Annotated[float, Field(gt=0, le=500)] = Field(default=125.0, description="rate of the published topics")
    port: Annotated[int, Field(ge=0, le=65535)] = Field(default=0, description="0: any free port; rosbridge has 9090")
    is_active: bool = Field(default=True, description="whether the arm's controller is active from the beginning")


class _Client:
    """One WebSocket connection."""

    def __init__(self) -> None:
        self.protocol = ServerProtocol()
        self.topics: set[str] = set()
        self.goals: set[str] = set()


class Ros2Emulator(WireEmulator):
    """Running emulator of rosbridge and its nodes."""

    def __init__(self, node: Node, options: Ros2EmulatorOptions) -> None:
        self._tcp = TcpPort(options.port)
        super().__init__(self._tcp, options, name="ros2")
        self.node = node
        self.period_s = 1.0 / options.rate_hz
        self._clients: dict[Peer, _Client] = {}

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: host, port, and those of the node."""
        return {**super().address, **self.node.options()}

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Accept a connection, or carry out what its frames ask for."""
        if not data:
            self._clients = {each: client for each, client in self._clients.items() if each in self._tcp.peers}
            self._clients[peer] = _Client()
            return
        client = self._clients[peer]
        client.protocol.receive_data(data)
        for event in client.protocol.events_received():
            if isinstance(event, Request):
                client.protocol.send_response(client.protocol.accept(event))
                self._flush(peer, client)
            elif isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                self._obey(peer, client, json.loads(bytes(event.data)))
        self._flush(peer, client)

    def _flush(self, peer: Peer, client: _Client) -> None:
        for data in client.protocol.data_to_send():
            self.reply(peer, data)

    def _obey(self, peer: Peer, client: _Client, message: Message) -> None:
        match message:
            case {"op": "subscribe", "topic": topic}:
                if self._has_type(peer, message, self.node.outputs):
                    client.topics.add(topic)
            case {"op": "unsubscribe", "topic": topic}:
                client.topics.discard(topic)
            case {"op": "advertise"}:
                self._has_type(peer, message, self.node.inputs)
            case {"op": "publish", "topic": topic, "msg": body} if topic in self.node.inputs:
                self.node.take(topic, body)
            case {"op": "call_service", "service": service}:
                values = self.node.serve(service, message.get("args", {}))
                answer = f"Service {service} does not exist" if values is None else values
                about = {"id": message.get("id"), "service": service, "result": values is not None}
                self._tell(peer, {"op": "service_response", **about, "values": answer})
            case {"op": "send_action_goal", "action": action, "id": id_}:
                if self.node.begin_goal(action, id_, message.get("args", {})):
                    client.goals.add(id_)

    def _has_type(self, peer: Peer, message: Message, known: dict[str, str]) -> bool:
        topic, type_ = message["topic"], message.get("type")
        actual = known.get(topic, type_)
        if type_ is None or actual is None or type_.replace("/msg/", "/") == actual.replace("/msg/", "/"):
            return topic in known
        what = f"Tried to use topic {topic} with type {type_}, but it is already established with type {actual}"
        self._tell(peer, {"op": "status", "level": "error", "msg": what})
        return False

    def _tell(self, peer: Peer, message: Message) -> None:
        self.reply(peer, self._frame(message))

    def _frame(self, message: Message) -> bytes:
        return Frame(Opcode.TEXT, json.dumps(message).encode()).serialize(mask=False)

    def on_tick(self) -> None:
        """Let the node work, and send what it publishes and which goals have ended."""
        messages, ended = self.node.tick(), self.node.ended_goals()
        clients = [(peer, client) for peer, client in self._clients.items() if peer in self._tcp.peers]
        for peer, client in clients:
            if client.protocol.state is not State.OPEN:
                continue
            for topic, message in messages:
                if topic in client.topics:
                    # The header of a WebSocket frame is the part in which damage is detected; TCP guards the rest.
                    self.send(
                        peer, self._frame({"op": "publish", "topic": topic, "msg": message}), protected=slice(0, 1)
                    )
            for id_, status, values in ended:
                if id_ in client.goals:
                    client.goals.discard(id_)
                    about = {"id": id_, "status": status, "result": bool(values)}
                    self._tell(peer, {"op": "action_result", **about, "values": values})

    def status_frame(self) -> bytes | None:
        """Return an error status of rosbridge."""
        return self._frame({"op": "status", "level": "error", "msg": "the message does not match its type"})


def start(backing: Device, options: dict[str, Any]) -> Ros2Emulator:
    """Start the emulator on an arm, a gripper or a force/torque sensor (entry point `ros2`)."""
    parsed = validate(options, Ros2EmulatorOptions, source="emulators.ros2")
    node: Node
    if isinstance(backing, Arm):
        node = ArmNode(backing, is_active=parsed.is_active)
    elif isinstance(backing, Gripper):
        node = GripperNode(backing)
    elif isinstance(backing, ForceTorque):
        node = ForceTorqueNode(backing)
    else:
        raise Unsupported(
            f"the emulator of ROS 2 cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind arm, gripper or force_torque as the emulator's backing device",
        )
    emulator = Ros2Emulator(node, parsed)
    emulator.begin()
    return emulator
