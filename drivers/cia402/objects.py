"""Objects of the drives by number or by name, checked against the drives' electronic data sheet (EDS, CiA 306)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.cia402.setup import CONSUMER, MAPPINGS, MODE, PRODUCER, Parameter

if TYPE_CHECKING:
    from canopen import ObjectDictionary
    from canopen.objectdictionary import ODVariable

NUMBER = re.compile(r"(?:0x)?([0-9A-Fa-f]{4})h?(?::(\d{1,3}))?")
INTEGER8, INTEGER16, INTEGER32, UNSIGNED16, UNSIGNED32, REAL32 = 0x2, 0x3, 0x4, 0x6, 0x7, 0x8  # CiA 301, 7.4.7
TYPES = {0x1: "BOOLEAN", INTEGER8: "INTEGER8", INTEGER16: "INTEGER16", INTEGER32: "INTEGER32", 0x5: "UNSIGNED8",
         UNSIGNED16: "UNSIGNED16", UNSIGNED32: "UNSIGNED32", REAL32: "REAL32"}  # fmt: skip
LARGEST_REAL32 = 3.4028234e38
LIMITS = {0x1: (0, 1), INTEGER8: (-(2**7), 2**7 - 1), INTEGER16: (-(2**15), 2**15 - 1),
          INTEGER32: (-(2**31), 2**31 - 1), 0x5: (0, 2**8 - 1), UNSIGNED16: (0, 2**16 - 1),
          UNSIGNED32: (0, 2**32 - 1), REAL32: (-LARGEST_REAL32, LARGEST_REAL32)}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Needed:
    """Object that the driver uses."""

    index: int
    sub: int = 0
    type: int
    is_written: bool = False
    is_mapped: bool = False


NEEDED = (
    Needed(index=0x6040, type=UNSIGNED16, is_written=True, is_mapped=True),
    Needed(index=0x607A, type=INTEGER32, is_written=True, is_mapped=True),
    Needed(index=0x6041, type=UNSIGNED16, is_mapped=True),
    Needed(index=0x6064, type=INTEGER32, is_mapped=True),
    Needed(index=0x606C, type=INTEGER32, is_mapped=True),
    Needed(index=0x6077, type=INTEGER16, is_mapped=True),
    Needed(index=MODE, type=INTEGER8, is_written=True),
    Needed(index=CONSUMER, sub=1, type=UNSIGNED32, is_written=True),
    Needed(index=PRODUCER, type=UNSIGNED16, is_written=True),
    *(Needed(index=index, sub=sub, type=UNSIGNED32) for index in MAPPINGS for sub in (1, 2)),
)
OWN = {(one.index, one.sub) for one in NEEDED if one.is_written}


def words(index: int, sub: int = 0) -> str:
    """Return the number of an object as manuals write it."""
    return f"{index:04X}h:{sub}" if sub else f"{index:04X}h"


def read_eds(path: Path) -> ObjectDictionary:
    """Return the object dictionary of an EDS or DCF file.

    Raises:
        ValueError: the file cannot be read or is no such file.
    """
    from canopen.objectdictionary import import_od

    try:
        found = import_od(str(path))
    except Exception as error:  # canopen raises whatever its parser meets
        raise ValueError(f"{path} cannot be read as an EDS: {error}") from error
    if not len(found):
        raise ValueError(f"{path} has no objects, so it is no EDS")
    return found


def faults_of(drive: ObjectDictionary, *, bitrate: int) -> list[str]:
    """Return why a drive with this object dictionary cannot be driven; empty if it can."""
    rates = drive.device_information.allowed_baudrates
    faults = [f"the drive does not have the bit rate {bitrate}"] if rates and bitrate not in rates else []
    return [*faults, *(fault for one in NEEDED for fault in _faults_of_one(drive, one))]


def _faults_of_one(drive: ObjectDictionary, needed: Needed) -> Iterable[str]:
    found, name = drive.get_variable(needed.index, needed.sub), words(needed.index, needed.sub)
    if found is None:
        yield f"there is no object {name}"
        return
    if found.data_type != needed.type:
        yield f"{name} is {_type_name(found)}, not {TYPES[needed.type]}"
    if needed.is_written and not found.writable:
        yield f"{name} cannot be written"
    if not needed.is_written and not found.readable:
        yield f"{name} cannot be read"
    if needed.is_mapped and not found.pdo_mappable:
        yield f"{name} cannot be mapped into a PDO"
    wanted = MAPPINGS[needed.index][needed.sub - 1] if needed.index in MAPPINGS else None
    if wanted is not None and not found.writable and found.default not in (None, wanted):
        yield f"{name} always maps {found.default:08X}, not {wanted:08X}"


def _type_name(found: ODVariable) -> str:
    return TYPES.get(found.data_type or 0, f"data type {found.data_type or 0:02X}h")


def parameters_of(given: Mapping[str, float], drive: ObjectDictionary | None) -> tuple[list[Parameter], list[str]]:
    """Return the objects to write, and what is wrong with those that cannot be written.

    Args:
        given: values by number (`6065`, `60C2:1`) or, with an EDS, by name (`Interpolation time period.Value`).
        drive: object dictionary; without it the drive itself is asked for an object's size.
    """
    found: list[Parameter] = []
    faults: list[str] = []
    for key, value in given.items():
        try:
            found.append(_parameter(key, value, drive))
        except ValueError as error:
            faults.append(f"{key!r} {error}")
    return found, faults


def _parameter(key: str, value: float, drive: ObjectDictionary | None) -> Parameter:
    number = NUMBER.fullmatch(key)
    if number is None and drive is None:
        raise ValueError("is no number such as 6065 or 60C2:1; names need `eds`")
    if drive is not None:
        variable = _by_name(key, drive) if number is None else _by_number(number, drive)
        index, sub, data = variable.index, variable.subindex, _encoded(variable, value)
    elif number is not None:
        index, sub, data = int(number[1], 16), int(number[2] or 0), None
        if value != int(value) or not -(2**31) <= value < 2**32:
            raise ValueError(f"cannot be {value}: without `eds` only whole numbers of 32 bits can be written")
    if (index, sub) in OWN:
        raise ValueError(f"is {words(index, sub)}, which the driver sets itself")
    return Parameter(index, sub, int(value), data)


def _by_number(number: re.Match[str], drive: ObjectDictionary) -> ODVariable:
    index, sub = int(number[1], 16), int(number[2] or 0)
    found = drive.get_variable(index, sub)
    if found is None:
        raise ValueError(f"is not in the EDS: it has no object {words(index, sub)}")
    return found


def _by_name(name: str, drive: ObjectDictionary) -> ODVariable:
    known: dict[str, ODVariable] = {}
    for entry in drive.values():
        members = (entry,) if not hasattr(entry, "subindices") else entry.subindices.values()
        known |= {member.qualname: member for member in members}
    if name in known:
        return known[name]
    near = get_close_matches(name, known, n=1)
    raise ValueError("is no object of the EDS" + (f"; is it {near[0]!r}?" if near else ""))


def _encoded(variable: ODVariable, value: float) -> bytes:
    """Return the value as the object's bytes.

    Raises:
        ValueError: the object cannot be written, or not with this value.
    """
    if not variable.writable:
        raise ValueError(f"({words(variable.index, variable.subindex)}) cannot be written")
    if variable.data_type not in LIMITS:
        raise ValueError(f"is {_type_name(variable)}, which is not a number of up to 32 bits")
    if variable.data_type != REAL32 and value != int(value):
        raise ValueError(f"is {_type_name(variable)}, so {value} is no value of it")
    low, high = LIMITS[variable.data_type]
    low = low if variable.min is None else max(variable.min, low)
    high = high if variable.max is None else min(variable.max, high)
    if not low <= value <= high:
        raise ValueError(f"must be from {low} to {high}, not {value}")
    return bytes(variable.encode_raw(value))
