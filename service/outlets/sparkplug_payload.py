"""Payloads of Sparkplug B 3.0, in the protobuf encoding of its file `sparkplug_b.proto`, as far as an edge node needs them."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

INT32, UINT64, DOUBLE, BOOLEAN, STRING = 3, 8, 10, 11, 12  # data types of the specification, section 6.4.16
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # wire types of protobuf
Value = bool | int | float | str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """A metric: in births with its name, else with its alias only.

    Attributes:
        datatype: one of the data types above.
        value: None is told as null.
        at_ms: milliseconds since 1970.
        is_historical: whether it is told later than it happened, and is not the newest value.
        properties: by name; an integer, a number or a text.
    """

    datatype: int
    value: Value
    at_ms: int
    name: str | None = None
    alias: int | None = None
    is_historical: bool = False
    properties: Mapping[str, int | float | str] = field(default_factory=dict)


def encoded(metrics: Sequence[Metric], *, at_ms: int, seq: int | None) -> bytes:
    """Return a payload; `seq` is None for NDEATH, which has none."""
    body = _number(1, at_ms) + b"".join(_bytes(2, _metric(one)) for one in metrics)
    return body + (b"" if seq is None else _number(3, seq))


def asks_for_rebirth(payload: bytes) -> bool:
    """Return whether an NCMD payload has the metric `Node Control/Rebirth` with true; what is no payload asks for nothing."""
    try:
        metrics = [
            dict(_fields(one)) for number, one in list(_fields(payload)) if number == 2 and isinstance(one, bytes)
        ]
    except (ValueError, IndexError):
        return False
    return any(one.get(1) == b"Node Control/Rebirth" and one.get(14) == 1 for one in metrics)


def _metric(one: Metric) -> bytes:
    found = b"" if one.name is None else _bytes(1, one.name.encode())
    found += b"" if one.alias is None else _number(2, one.alias)
    found += _number(3, one.at_ms) + _number(4, one.datatype)
    found += _number(5, 1) if one.is_historical else b""
    found += _number(7, 1) if one.value is None else b""
    if one.properties:
        keys = b"".join(_bytes(1, key.encode()) for key in one.properties)
        found += _bytes(9, keys + b"".join(_bytes(2, _property(value)) for value in one.properties.values()))
    return found + _value(one.datatype, one.value, first=10)


def _property(value: float | str) -> bytes:
    kind = STRING if isinstance(value, str) else INT32 if isinstance(value, int) else DOUBLE
    return _number(1, kind) + _value(kind, value, first=3)


def _value(datatype: int, value: Value, *, first: int) -> bytes:
    """Return the value in its field; `first` is the number of `int_value`, which the others follow in the same order."""
    if value is None:
        return b""
    if datatype == STRING:
        return _bytes(first + 5, str(value).encode())
    if datatype == BOOLEAN:
        return _number(first + 4, int(value))
    if datatype == DOUBLE:
        return _varint((first + 3) << 3 | FIXED64) + struct.pack("<d", float(value))
    return _number(first + (datatype == UINT64), int(value) & (2**64 - 1 if datatype == UINT64 else 2**32 - 1))


def _number(number: int, value: int) -> bytes:
    return _varint(number << 3 | VARINT) + _varint(value)


def _bytes(number: int, value: bytes) -> bytes:
    return _varint(number << 3 | BYTES) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and content of each field of a message."""
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        kind, content = key & 7, b""
        if kind == VARINT:
            value, at = _read_varint(data, at)
            yield key >> 3, value
            continue
        if kind == BYTES:
            length, at = _read_varint(data, at)
        elif kind in (FIXED32, FIXED64):
            length = 4 if kind == FIXED32 else 8
        else:
            raise ValueError("unknown wire type")
        content, at = data[at : at + length], at + length
        if at > len(data):
            raise ValueError("the message is cut off")
        yield key >> 3, content


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        value |= (data[at] & 0x7F) << shift
        at += 1
        if data[at - 1] < 0x80:
            return value, at
    raise ValueError("a number has more than ten bytes")
