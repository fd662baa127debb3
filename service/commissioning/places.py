"""Restricts the ports, hosts and files that a client may name for a device while the cell runs.

Without it, whoever reaches the HTTP port could make the cell open any file as a port and connect to any machine.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from hal.config import Cell
from hal.errors import InvalidRequest

KEYS = ("host", "port", "channel", "device", "url", "address", "interface")


@dataclass(frozen=True, slots=True, kw_only=True)
class AllowedPlaces:
    """The places that devices of a cell may use.

    Attributes:
        own: the places in the cell file, exactly as they are there.
        patterns: further places, in which `*` stands for anything; a host without a port stands for all its ports.
    """

    own: frozenset[str]
    patterns: tuple[str, ...]

    @classmethod
    def of(cls, cell: Cell, recordings: Path) -> AllowedPlaces:
        """Return the places of a cell file, and all files in the folder `recordings`."""
        options = [section.options for section in cell.file.devices.values()]
        options += [section.options for section in cell.file.emulators.values()]
        own = frozenset(place for each in options for place in places_of(each))
        return cls(own=own, patterns=(*cell.file.safety.allowed_places, f"{recordings.resolve()}/*"))

    def check(self, name: str, options: Mapping[str, Any]) -> None:
        """Raise `InvalidRequest` when the options of the device `name` lead to a place that is not allowed."""
        for place in places_of(options) - self.own:
            without_port = place.rpartition(":")[0]
            if not any(fnmatchcase(place, pattern) or without_port == pattern for pattern in self.patterns):
                raise InvalidRequest(
                    f"devices.{name}: {place[:200]!r} is none of the ports and hosts that this cell may use",
                    hint="add it to safety.allowed_places in the cell file, where * stands for anything",
                    device=name,
                )


def places_of(options: Mapping[str, Any]) -> frozenset[str]:
    """Return the ports, hosts, addresses and existing files that options name; `HOST:PORT` where both are given."""
    host = options.get("host")
    if not isinstance(host, str):
        return frozenset(_named("", dict(options)))
    port = options.get("port")
    others = {key: value for key, value in options.items() if key not in ("host", "port")}
    return frozenset({host if port is None else f"{host}:{port}", *_named("", others)})


def _named(key: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for inner, item in value.items():
            yield from _named(str(inner), item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _named(key, item)
    elif isinstance(value, str) and (key in KEYS or "://" in value or _is_file(value)):
        yield os.path.normpath(value) if value.startswith("/") else value  # "/dev/../etc" does not match "/dev/*"
    elif isinstance(value, int) and key in KEYS:
        yield str(value)


def _is_file(value: str) -> bool:
    try:
        return "/" in value and Path(value).exists()
    except (OSError, ValueError):
        return False
