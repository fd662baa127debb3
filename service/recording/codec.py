"""Writes the values of the device interfaces as JSON and reads them back, equal to the last bit.

JSON's own types stand for themselves; a list is a tuple. Everything else is an object with one key that begins with
`$`, or a `$class` with its fields. Only classes of the device interfaces are made again, so a file of unknown origin
cannot run anything.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from hal.errors import CellError, ConfigError

CLASSES = "$class"
MODULES = (
    "hal.devices",
    "hal.camera_settings",
    "hal.readings",
    "hal.motion",
    "hal.calibration",
    "hal.simulated",
    "hal.geometry",
)
ERRORS = ("hal.errors", "service.errors")
LISTED = 64  # elements; longer arrays are written as bytes, which are smaller and read faster

Picture = Callable[[NDArray[Any]], dict[str, Any] | None]
"""Stores an image apart and returns the reference to write in its place; None to write it here."""


class Unreadable(ConfigError):
    """A recording holds a value that this version cannot make again."""


def encode(value: Any, picture: Picture = lambda _array: None) -> Any:
    """Return plain JSON values for a value of the device interfaces.

    Args:
        picture: is offered each array that is an image or a range image.
    """
    if value is None or (isinstance(value, bool | int | str) and not isinstance(value, Enum)):
        return value
    if type(value) is float:
        return value if math.isfinite(value) else {"$float": repr(value)}
    if isinstance(value, tuple):
        return [encode(item, picture) for item in value]
    if isinstance(value, list):
        return {"$list": [encode(item, picture) for item in value]}
    if isinstance(value, np.ndarray | np.generic):
        return (picture(value) if isinstance(value, np.ndarray) else None) or _array(np.asarray(value), value)
    if isinstance(value, Mapping):
        return {"$map": [[encode(key, picture), encode(item, picture)] for key, item in value.items()]}
    return _instance(value, picture)


def _array(array: NDArray[Any], value: Any) -> dict[str, Any]:
    order = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    about: dict[str, Any] = {"dtype": array.dtype.str, "shape": list(array.shape), "order": order}
    if isinstance(value, np.generic):
        about["scalar"] = True
    is_short = array.size <= LISTED and array.dtype.kind in "fiub"
    if is_short and (array.dtype.kind != "f" or bool(np.isfinite(array).all())):
        return {"$array": about | {"values": array.ravel(order="C").tolist()}}
    return {"$array": about | {"base64": base64.b64encode(array.tobytes(order="C")).decode()}}


def _instance(value: Any, picture: Picture) -> Any:
    if isinstance(value, RigidTransform):
        return {"$pose": encode(np.asarray(value.as_matrix()))}
    if isinstance(value, Rotation):
        return {"$rotation": encode(np.asarray(value.as_quat()))}
    if isinstance(value, bytes):
        return {"$bytes": base64.b64encode(value).decode()}
    kind = f"{type(value).__module__}.{type(value).__qualname__}"
    if isinstance(value, Enum):
        return {"$enum": [kind, value.value]}
    if is_dataclass(value):
        return {CLASSES: kind} | {field.name: encode(getattr(value, field.name), picture) for field in fields(value)}
    return {"$opaque": kind}


def encode_error(error: BaseException) -> dict[str, Any]:
    """Return plain JSON values for an error that a device raised."""
    kind = f"{type(error).__module__}.{type(error).__qualname__}"
    if isinstance(error, CellError):
        return {"class": kind, "what": error.what, "hint": error.hint, "details": encode(error.details)}
    return {"class": kind, "what": f"{type(error).__name__}: {error}"}


def decode(value: Any, picture: Callable[[dict[str, Any]], NDArray[Any]] | None = None) -> Any:
    """Return the value of which `encode` made `value`.

    Args:
        picture: returns the array for a reference that `encode`'s `picture` returned.

    Raises:
        Unreadable: it holds something that cannot be made again.
    """
    if isinstance(value, list):
        return tuple(decode(item, picture) for item in value)
    if not isinstance(value, dict):
        return value
    try:
        return _object(value, picture)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        hint = "it may be damaged, or written by another version of panelwright"
        raise Unreadable(f"the recording holds a value that cannot be read: {error!r}", hint=hint) from error


def _object(value: dict[str, Any], picture: Callable[[dict[str, Any]], NDArray[Any]] | None) -> Any:
    if CLASSES in value:
        parts = {key: decode(item, picture) for key, item in value.items() if key != CLASSES}
        return _class(value[CLASSES], MODULES)(**parts)
    ((tag, inner),) = value.items()
    match tag:
        case "$float":
            return float(inner)
        case "$list":
            return [decode(item, picture) for item in inner]
        case "$map":
            return {decode(key, picture): decode(item, picture) for key, item in inner}
        case "$array":
            return _array_of(inner)
        case "$pose":
            return RigidTransform(decode(inner), normalize=False)
        case "$rotation":
            return Rotation(decode(inner), normalize=False)
        case "$bytes":
            return base64.b64decode(inner)
        case "$enum":
            return _class(inner[0], MODULES)(inner[1])
        case "$picture":
            if picture is not None:
                return picture(inner)
    raise ValueError(f"{tag} {inner if tag == '$opaque' else ''}")


def _array_of(about: dict[str, Any]) -> Any:
    kind, shape = np.dtype(about["dtype"]), tuple(about["shape"])
    if "values" in about:
        array = np.array(about["values"], kind).reshape(shape)
    else:
        array = np.frombuffer(base64.b64decode(about["base64"]), kind).reshape(shape).copy()
    if about.get("scalar"):
        return array[()]
    return np.asfortranarray(array) if about["order"] == "F" else array


def decode_error(value: dict[str, Any]) -> BaseException:
    """Return the error of which `encode_error` made `value`; a defect of a driver becomes a `RuntimeError`."""
    if "hint" not in value:
        return RuntimeError(value["what"])
    kind = _class(value["class"], ERRORS) if value["class"].startswith(ERRORS) else CellError
    error: CellError = kind.__new__(kind)
    CellError.__init__(error, value["what"], hint=value["hint"], **decode(value["details"]))
    return error


def _class(name: str, modules: tuple[str, ...]) -> Any:
    module, _, kind = name.rpartition(".")
    if module not in modules:
        raise ValueError(f"{name} is no class of the device interfaces")
    found = getattr(import_module(module), kind)
    if not (isinstance(found, type) and found.__module__ == module):
        raise ValueError(f"{name} is no class of the device interfaces")
    return found
