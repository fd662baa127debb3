"""Tests of messages: recorded ones are replayed, and those that are sent have the types that ROS 2 defines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from drivers.emulators.ros2_nodes import ArmNode, ForceTorqueNode, GripperNode
from drivers.emulators.scripted import ScriptedArm, ScriptedForceTorque, ScriptedGripper
from drivers.kinds.arms import ur10e
from drivers.ros2.messages import (
    JOINT_TRAJECTORY,
    NANO,
    POSITIONS,
    BadMessage,
    duration,
    joints_of,
    positions,
    trajectory,
    wrench_of,
)
from hal.devices import Arm, Gripper
from hal.registry import Context, connect
from tests.drivers.rigs import until

VECTORS = json.loads((Path(__file__).parent / "messages.json").read_text(encoding="utf-8"))
UR_JOINTS = [f"{part}_joint" for part in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
OPTIONS = {
    "ros2:arm": {"joints": UR_JOINTS, "kinematics": ur10e().model_dump(mode="json")},
    "ros2:gripper": {"joint": "finger_joint"},
    "ros2:force_torque": {},
}
ROS = get_typestore(Stores.ROS2_JAZZY)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["name", "position", "header"]), inner),
    max_leaves=12,
)


def as_ros(type_: str, message: dict[str, Any]) -> Any:
    """Return the message as the class that the definition of its type gives; it takes every field and no other."""
    fields, basic = ROS.fielddefs[type_][1], ("float64", "string", "int32", "uint32")
    assert {name for name, _ in fields} == set(message), type_

    def value(definition: Any, given_value: Any) -> Any:
        node, inner = definition
        if node.name == "NAME":
            return as_ros(inner, given_value)
        if node.name in ("ARRAY", "SEQUENCE"):
            items = [value(inner[0], item) for item in given_value]
            return np.array(items, dtype=np.float64) if inner[0][1][0] == "float64" else items
        assert inner[0] in basic
        return given_value

    return ROS.types[type_](**{name: value(definition, message[name]) for name, definition in fields})


@pytest.mark.parametrize("vector", VECTORS, ids=[vector["about"][:40] for vector in VECTORS])
def test_recorded_messages_are_read_as_they_were_meant(vector: dict[str, Any], tmp_path: Path) -> None:
    path, expected = tmp_path / "recorded.jsonl", vector["expected"]
    recorded = [{"t": 0.0, "dir": "open", "name": "websocket", "byte_s": 0.0}]
    recorded += [{"t": e["t"], "dir": "rx", "hex": (e["text"] + "\n").encode().hex()} for e in vector["lines"]]
    recorded.append({"t": 3.0, "dir": "rx", "hex": ""})
    path.write_text("".join(json.dumps(line) + "\n" for line in recorded), encoding="ascii")
    options = {**OPTIONS[vector["driver"]], "replay": str(path), "max_age_s": 2.0}
    device: Any = connect(Context(name="replayed"), vector["driver"], options)
    try:
        until(lambda: device.mailbox.peek().device_time_s == pytest.approx(expected["device_time_s"], abs=1e-6))
        sample = device.mailbox.peek()
        assert device.errors == expected["errors"], device.wire_counts()
        assert sample.quality == expected.get("quality", "valid")
        for key in set(expected) - {"device_time_s", "errors", "quality"}:
            np.testing.assert_allclose(getattr(sample.value, key), expected[key], atol=1e-9)
    finally:
        device.close()


def test_commands_have_the_types_that_ros_defines() -> None:
    path = trajectory(UR_JOINTS, np.arange(6.0), 0.05, velocity_rad_per_s=np.zeros(6))
    for type_, message in ((JOINT_TRAJECTORY, path), (POSITIONS, positions(np.arange(6.0)))):
        again = ROS.deserialize_cdr(ROS.serialize_cdr(as_ros(type_, message), type_), type_)
        if type_ == JOINT_TRAJECTORY:
            assert again.joint_names == UR_JOINTS
            assert (again.header.stamp.sec, again.points[0].time_from_start.nanosec) == (0, 50_000_000)
            np.testing.assert_array_equal(again.points[0].positions, np.arange(6.0))
        else:
            np.testing.assert_array_equal(again.data, np.arange(6.0))


def test_what_the_emulated_nodes_publish_has_the_types_that_ros_defines() -> None:
    devices = (ScriptedArm(), ScriptedGripper(), ScriptedForceTorque())
    for backing in devices:
        node: Any
        if isinstance(backing, Arm):
            node = ArmNode(backing, is_active=True)
        else:
            node = GripperNode(backing) if isinstance(backing, Gripper) else ForceTorqueNode(backing)
        for topic, message in node.tick():
            type_ = node.outputs[topic]
            ROS.serialize_cdr(as_ros(type_, message), type_)


@given(st.floats(0.0, 3000.0))
def test_a_duration_is_exact_to_the_nanosecond(lasts_s: float) -> None:
    given_back = duration(lasts_s)
    assert 0 <= given_back["nanosec"] < 10**9
    assert given_back["sec"] + NANO * given_back["nanosec"] == pytest.approx(lasts_s, abs=1e-9)


@given(JSON)
def test_no_message_of_any_shape_is_more_than_a_bad_message(message: Any) -> None:
    if not isinstance(message, dict):
        return
    for read in (lambda: joints_of(message, ["a", "b"]), lambda: wrench_of(message)):
        try:
            read()
        except BadMessage:
            continue
