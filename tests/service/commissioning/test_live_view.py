"""The live view of a running service, as a WebSocket client that Foxglove did not write either sees it."""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from PIL import Image as PillowImage
from websockets.sync.client import ClientConnection, connect

from hal.errors import ConfigError
from service.client import Client
from service.commissioning.live_view import LiveView
from service.recording.live import LiveServer
from service.serve import Panelwright

pytest.importorskip("foxglove", reason="the extra `foxglove` is not installed")
WAIT_S = 30.0


def receive(socket: ClientConnection, kind: str) -> dict[str, Any]:
    """Return the next JSON message of a kind."""
    while True:
        text = socket.recv(timeout=WAIT_S)
        if isinstance(text, str) and json.loads(text)["op"] == kind:
            found: dict[str, Any] = json.loads(text)
            return found


def test_a_client_sees_what_the_cell_sees(served: Panelwright) -> None:
    server = LiveServer(0)
    view = LiveView(Client(url=served.url), server)
    state = {"position_rad": [0.5] * 6, "velocity_rad_per_s": [0.0] * 6, "base_from_panel": None}
    pose = {"translation_m": [1.0, 2.0, 3.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}

    def show() -> None:
        view.show_state({**state, "base_from_flange": pose})
        view.show_frames()
        view.show_pictures()

    try:
        show()  # makes the channels
        with connect(server.url, subprotocols=["foxglove.sdk.v1"], proxy=None) as socket:  # type: ignore[list-item]
            assert receive(socket, "serverInfo")["name"] == "panelwright"
            channels: dict[str, Any] = {}
            while len(channels) < 6:
                channels |= {one["topic"]: one for one in receive(socket, "advertise")["channels"]}
            assert channels["/wrist_camera/image"]["schemaName"] == "foxglove.CompressedImage"
            wanted = ["/joint_states", "/tf", "/wrist_camera/image", "/range_scanner/points"]
            asked = [{"id": k, "channelId": channels[topic]["id"]} for k, topic in enumerate(wanted)]
            socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            found = first_of_each(socket, len(wanted), show)
    finally:
        server.close()
    assert [joint.position for joint in JointStates.FromString(found[0]).joints] == [0.5] * 6
    first = FrameTransforms.FromString(found[1]).transforms[0]
    assert (first.parent_frame_id, first.child_frame_id) in {("base", "flange"), ("flange", "wrist_camera")}
    image = CompressedImage.FromString(found[2])
    assert np.asarray(PillowImage.open(io.BytesIO(image.data))).shape == (48, 64, 3)
    assert len(PointCloud.FromString(found[3]).data) > 0


def first_of_each(socket: ClientConnection, topics: int, show: Any) -> dict[int, bytes]:
    """Return the first message on each subscription; `show` is repeated, as the subscriptions take effect later."""
    found: dict[int, bytes] = {}
    while len(found) < topics:
        show()
        try:
            while len(found) < topics:
                data = socket.recv(timeout=0.2)
                if isinstance(data, bytes):
                    opcode, subscription, _time_ns = struct.unpack("<BIQ", data[:13])
                    assert opcode == 1
                    found.setdefault(subscription, data[13:])
        except TimeoutError:
            continue
    return found


class Screen:
    """Remembers what was shown."""

    def __init__(self) -> None:
        self.shown: list[tuple[str, Any]] = []

    def show(self, topic: str, message: Any, *, time_ns: int) -> None:
        self.shown.append((topic, message))

    def show_json(self, topic: str, value: Any, *, time_ns: int) -> None:
        self.shown.append((topic, value))


def test_each_step_of_a_task_is_one_line_of_the_log(served: Panelwright) -> None:
    client, screen = Client(url=served.url), Screen()
    view = LiveView(client, screen)
    view.show_tasks()
    before = len(screen.shown)
    task = client.post("/v1/echo?wait_s=10", {"text": "hello"})
    assert task["state"] == "succeeded"
    view.show_tasks()
    view.show_tasks()
    (line,) = [message for topic, message in screen.shown[before:] if topic == "/log"]
    assert (line.name, line.message) == ("echo", "echo succeeded: speaking")


def test_a_cell_that_cannot_be_read_shows_why() -> None:
    screen = Screen()
    LiveView(Client(), screen).show_state({"is_latched": True, "problem": "the arm is off"})
    assert screen.shown == [("/state", {"is_latched": True, "problem": "the arm is off"})]


def test_a_port_in_use_is_an_error_with_a_remedy() -> None:
    first = LiveServer(0)
    try:
        with pytest.raises(ConfigError, match="cannot listen"):
            LiveServer(int(first.url.rsplit(":", 1)[1]))
    finally:
        first.close()
