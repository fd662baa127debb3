"""Protobuf messages of what the control loop reads and sends, one class for each kind of reading.

They are made at run time from the table `FORMS`, so that the control loop hands over plain numbers and another process
makes messages of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message import Message

from hal.devices import DeviceKind

Field = FieldDescriptorProto
PACKAGE = "panelwright"
COMMON = (
    ("timestamp", Field.TYPE_MESSAGE, False),
    ("host_time_s", Field.TYPE_DOUBLE, False),
    ("device_time_s", Field.TYPE_DOUBLE, False),  # NaN when the device has no clock
    ("sequence", Field.TYPE_INT64, False),
    ("quality", Field.TYPE_STRING, False),
    ("cause", Field.TYPE_STRING, False),
)


@dataclass(frozen=True, slots=True)
class Form:
    """The message of one call: its name, and the names of its values; `many` are lists, `flags` booleans."""

    name: str
    values: tuple[str, ...]
    many: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()


FORMS: dict[tuple[DeviceKind, str], Form] = {
    (DeviceKind.ARM, "read_state"): Form(
        "JointReading",
        ("position_rad", "velocity_rad_per_s", "is_enabled", "is_moving"),
        many=("position_rad", "velocity_rad_per_s"),
        flags=("is_enabled", "is_moving"),
    ),
    (DeviceKind.ARM, "command_position"): Form("SetPoint", ("wanted_rad", "sent_rad"), many=("wanted_rad", "sent_rad")),
    (DeviceKind.GRIPPER, "read_state"): Form(
        "GripperReading", ("width_m", "force_n", "is_moving", "is_holding"), flags=("is_moving", "is_holding")
    ),
    (DeviceKind.PROXIMITY, "read_distance_m"): Form("DistanceReading", ("distance_m",)),
    (DeviceKind.TOUCH, "read_contacts"): Form("ContactReading", ("contacts",), many=("contacts",), flags=("contacts",)),
    (DeviceKind.FORCE_TORQUE, "read_wrench"): Form(
        "WrenchReading", ("force_n", "torque_nm"), many=("force_n", "torque_nm")
    ),
}


@cache
def message_class(form: Form) -> Any:
    """Return the message class of a form."""
    file = FileDescriptorProto(
        name=f"panelwright/{form.name}.proto",
        package=PACKAGE,
        syntax="proto3",
        dependency=[timestamp_pb2.DESCRIPTOR.name],
    )
    message = file.message_type.add(name=form.name)
    own = [
        (name, Field.TYPE_BOOL if name in form.flags else Field.TYPE_DOUBLE, name in form.many) for name in form.values
    ]
    for number, (name, kind, is_many) in enumerate([*COMMON, *own], start=1):
        field = message.field.add(name=name, number=number, type=kind)
        field.label = Field.LABEL_REPEATED if is_many else Field.LABEL_OPTIONAL
        if kind == Field.TYPE_MESSAGE:
            field.type_name = f".{timestamp_pb2.Timestamp.DESCRIPTOR.full_name}"
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{form.name}"))


class Row(NamedTuple):
    """What the control loop hands over for one call: plain numbers only, because it makes thousands of calls a second.

    Attributes:
        place: number of the device and method in the tap's table.
        time_s: cell time at the end of the call; `wall_s` is the same on the monotonic clock.
        stamp: host time, device time, sequence, quality and cause; None for a command.
        values: in the order of the form.
    """

    place: int
    time_s: float
    wall_s: float
    stamp: tuple[float, float | None, int, str, str] | None
    values: tuple[Any, ...]


def sample_of(form: Form, row: Row, time_ns: int) -> Message:
    """Return the message for a row."""
    message: Any = message_class(form)()
    message.timestamp.FromNanoseconds(time_ns)
    if row.stamp is not None:
        host_s, device_s, message.sequence, message.quality, message.cause = row.stamp
        message.host_time_s = host_s
        message.device_time_s = float("nan") if device_s is None else device_s
    for name, value in zip(form.values, row.values, strict=True):
        if name in form.many:
            getattr(message, name).extend(value)
        else:
            setattr(message, name, value)
    shown: Message = message
    return shown
