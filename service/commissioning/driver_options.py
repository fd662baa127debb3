"""Describes installed drivers by the models of their options: tables of all keys, and an example for a cell file."""

from __future__ import annotations

import json
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from hal.devices import DeviceKind
from hal.registry import device_factory, kinds_of, options_model
from hal.strict import Strict
from hal.toml_text import toml_text
from hal.wires import WireOptions

UNITS = {  # by the end of a key; longer ends first
    "_m_per_s": "m/s",
    "_rad_per_s2": "rad/s²",
    "_rad_per_s": "rad/s",
    "_per_nm": "1/(N·m)",
    "_per_n": "1/N",
    "newtons_per_ampere": "N/A",
    "degrees_per_increment": "deg",
    "hundredths_deg": "0.01 deg",
    "bitrate": "bit/s",
    "baud": "baud",
    "_electrons": "electrons",
    "_rad": "rad",
    "_deg": "deg",
    "_ratio": "ratio",
    "_nm": "N·m",
    "_px": "px",
    "_hz": "Hz",
    "_kg": "kg",
    "_ms": "ms",
    "_db": "dB",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}
MANY = {"number": "numbers", "whole number": "whole numbers", "text": "texts", "table": "tables", "choice": "choices"}
PLAIN = {float: "number", int: "whole number", bool: "true or false", str: "text", Path: "path", type(None): "none"}
EXAMPLES: dict[str, Any] = {  # of keys that a cell file must give
    "port": "/dev/serial/by-id/usb-ADAPTER",
    "host": "192.168.1.10",
    "channel": "can0",
    "path": "recordings",
    "url": "rtsp://192.168.1.20/stream1",
}
BY_TYPE: dict[type, Any] = {bool: True, int: 1, float: 1.0, str: "NAME", Path: "FILE"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """One key of a driver's options, in words."""

    key: str
    type: str
    unit: str
    default: str
    range: str
    description: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverInfo:
    """What the models of an installed driver tell about it.

    Attributes:
        wire: the wires that it can use, such as `serial or tcp`; `none` without one.
        example: a section of a cell file with every key that must be given.
    """

    name: str
    kind: DeviceKind
    wire: str
    options: tuple[Option, ...]
    example: str


def describe(driver: str) -> DriverInfo:
    """Return the description of an installed driver.

    Raises:
        ConfigError: there is no such driver; the error names the nearest one.
    """
    factory = device_factory(driver)
    model, kinds = options_model(factory), kinds_of(factory)
    kind = kinds[0] if kinds else DeviceKind.PROXIMITY
    given = example_of(model) if model is not None else {}
    return DriverInfo(
        name=driver,
        kind=kind,
        wire=_wire(driver, model, given),
        options=() if model is None else tuple(options_of(model)),
        example=_section(str(kind), driver, given),
    )


def options_of(model: type[BaseModel], prefix: str = "") -> Iterator[Option]:
    """Yield every key of a model, followed by the keys of the tables in it."""
    for name, info in model.model_fields.items():
        words, limits, below = _type(info.annotation, info.metadata)
        yield Option(
            key=prefix + name,
            type=words,
            unit=next((unit for end, unit in UNITS.items() if name.endswith(end)), ""),
            default=_default(info, is_table=below is not None),
            range=limits,
            description=described(model, name),
        )
        if below is not None:
            yield from options_of(below, f"{prefix}{name}{'[]' if words.startswith('list') else ''}.")


def described(model: type[BaseModel], name: str) -> str:
    """Return the description of a field, which a model that only changes the default inherits."""
    fields = (base.model_fields.get(name) for base in model.__mro__ if issubclass(base, BaseModel))
    return next((info.description for info in fields if info is not None and info.description), "")


def example_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return options with every required key; a model with an `example` method gives its own."""
    own = getattr(model, "example", None)
    if own is not None:
        return dict(own())
    required = {name: info for name, info in model.model_fields.items() if info.is_required()}
    given = {name: _value(name, info) for name, info in required.items()}
    if "host" in model.model_fields and "host" not in given and "port" not in given:
        given["host"] = EXAMPLES["host"]  # the default port is that of a network
    return given


def _value(name: str, info: FieldInfo) -> Any:
    if info.examples:
        return info.examples[0]
    words, _, below = _type(info.annotation, info.metadata)
    if words.startswith("list"):
        return [] if below is None else [example_of(below)]
    if below is not None:
        return example_of(below)
    kind = next((each for each in _parts(info.annotation) if each in BY_TYPE), str)
    return EXAMPLES.get(name, BY_TYPE[kind]) if kind in (str, Path) else BY_TYPE[kind]


def _parts(annotation: Any) -> tuple[Any, ...]:
    """Return the alternatives of a type, without their limits."""
    if get_origin(annotation) is Annotated:
        return _parts(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return tuple(part for each in get_args(annotation) for part in _parts(each))
    return (annotation,)


def _type(annotation: Any, metadata: list[Any]) -> tuple[str, str, type[BaseModel] | None]:
    """Return the type in words, its limits in words, and the model of the table that it is or lists."""
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return _type(inner, [*more, *metadata])
    if get_origin(annotation) in (Union, types.UnionType):
        alternatives = [_type(each, metadata) for each in get_args(annotation) if each is not type(None)]
        words = " or ".join(dict.fromkeys(each[0] for each in alternatives))
        limits = "; ".join(dict.fromkeys(each[1] for each in alternatives if each[1]))
        return words, limits, next((each[2] for each in alternatives if each[2]), None)
    if get_origin(annotation) is tuple:
        words, limits, below = _type(get_args(annotation)[0], [])
        return f"list of {MANY.get(words, words)}", f"each {limits}" if limits else "", below
    if get_origin(annotation) is dict:
        return "table", "", None
    if get_origin(annotation) is Literal:
        return "choice", ", ".join(_toml(each) for each in get_args(annotation)), None
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table", "", annotation
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return "choice", ", ".join(_toml(str(each.value)) for each in annotation), None
    return PLAIN.get(annotation, str(annotation)), _limits(metadata), None


def _limits(metadata: list[Any]) -> str:
    found: dict[str, Any] = {}
    for item in metadata:
        for each in (item, *(getattr(item, "metadata", None) or ())):
            found |= {name: getattr(each, name) for name in ("ge", "gt", "le", "lt") if hasattr(each, name)}
    low, high = found.get("ge", found.get("gt")), found.get("le", found.get("lt"))
    if low is None and high is None:
        return ""
    if low is not None and high is not None and not found.keys() & {"gt", "lt"}:
        return f"{low} to {high}"
    lower = "" if low is None else f"{'>' if 'gt' in found else '≥'} {low}"
    upper = "" if high is None else f"{'<' if 'lt' in found else '≤'} {high}"
    return " and ".join(word for word in (lower, upper) if word)


def _default(info: FieldInfo, *, is_table: bool) -> str:
    if info.is_required():
        return "must be given"
    value = info.get_default(call_default_factory=True, validated_data={})
    if value is None:
        return "none"
    return "see its description" if is_table else _toml(value)


def _toml(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(_toml(each) for each in value)}]"
    plain = value if isinstance(value, bool | int | float) else str(value)
    return toml_text({"x": plain}).strip().removeprefix("x = ")


def _wire(driver: str, model: type[Strict] | None, given: Mapping[str, Any]) -> str:
    if model is None or not issubclass(model, WireOptions):
        return "simulation" if driver.startswith("sim:") else "none"
    try:
        words = [claim.wire.split()[0].lower() for claim in model.model_validate_json(json.dumps(given)).claims()]
    except ValidationError:
        words = []
    port = model.model_fields.get("port")
    if port is not None and {int, str} <= set(_parts(port.annotation)):
        words = ["serial", "tcp"]
    return " or ".join(dict.fromkeys(words)) or driver.partition(":")[0]


def _section(kind: str, driver: str, given: Mapping[str, Any]) -> str:
    """Return the section of a cell file for a device with these options."""
    plain = {key: value for key, value in given.items() if not isinstance(value, Mapping)}
    parts = [f"[devices.my_{kind}]\n{toml_text({'kind': kind, 'driver': driver})}"]
    if plain:
        parts.append(f"[devices.my_{kind}.options]\n{toml_text(plain)}")
    for key, table in given.items():
        if isinstance(table, Mapping):
            rows = "".join(f"{name} = {_inline(value)}\n" for name, value in table.items())
            parts.append(f"[devices.my_{kind}.options.{key}]\n{rows}")
    return "\n".join(parts).strip() + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        return "[\n" + "".join(f"    {_inline(each)},\n" for each in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + " }"
    return _toml(value)
