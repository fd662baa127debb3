"""Universal Robots RTDE, protocol version 2: encoding and parsing of packages (UR RTDE guide)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from drivers.transport.options import PortNumber, TcpOptions
from hal.wires import ResourceClaim

HEADER = struct.Struct(">HB")
TYPES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
KNOWN = frozenset(b"VvOIUSPM")
LONGEST = 4096
IN_USE = "IN_USE"
REFUSALS = {"NOT_FOUND": "is not known to this controller", IN_USE: "is taken by another client"}


class RtdeOptions(TcpOptions):
    """Keys of every RTDE client; a controller serves several, but each part that a client `owns` has one owner only."""

    owns: ClassVar[tuple[str, ...]] = ()
    port: PortNumber = 30_004

    def claim(self) -> ResourceClaim:
        """Claim the parts of the controller that the client owns."""
        return ResourceClaim(wire=f"tcp {self.host}:{self.port}", bus="RTDE", stations=self.owns)


class RecipeRefused(ValueError):
    """The controller does not have a variable."""


class VariableInUse(RecipeRefused):
    """Another client owns an input variable."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Variables of a data package and how they are packed (big-endian)."""

    id: int
    names: tuple[str, ...]
    packing: struct.Struct
    widths: tuple[int, ...]

    def unpack(self, payload: bytes) -> dict[str, float | int | tuple[float, ...]]:
        """Return values by name from the payload of a `U` package."""
        values = iter(self.packing.unpack(payload[1:]))
        return {
            name: next(values) if width == 1 else tuple(next(values) for _ in range(width))
            for name, width in zip(self.names, self.widths, strict=True)
        }

    def pack(self, values: Sequence[float | int]) -> bytes:
        """Return a `U` package of the flat values."""
        return package("U", bytes([self.id]) + self.packing.pack(*values))


def recipe(id_: int, names: Sequence[str], types: Sequence[str]) -> Recipe:
    """Return a recipe as confirmed by the controller.

    Raises:
        RecipeRefused: a variable is NOT_FOUND or IN_USE (`VariableInUse`).
    """
    for name, kind in zip(names, types, strict=True):
        if kind not in TYPES:
            refusal = VariableInUse if kind == IN_USE else RecipeRefused
            raise refusal(f"{name} {REFUSALS.get(kind, f'has the unknown type {kind}')}")
    codes = [TYPES[kind] for kind in types]
    widths = tuple(int(code[:-1] or 1) for code in codes)
    return Recipe(id_, tuple(names), struct.Struct(">" + "".join(codes)), widths)


def package(kind: str, payload: bytes = b"") -> bytes:
    """Return a package: size, type, payload."""
    return HEADER.pack(HEADER.size + len(payload), ord(kind)) + payload


def outputs_request(names: Sequence[str], rate_hz: float) -> bytes:
    """Return the request for variables at a rate."""
    return package("O", struct.pack(">d", rate_hz) + ",".join(names).encode())


def split_names(text: bytes) -> tuple[str, ...]:
    """Return the names in a comma-separated list, which may end with a comma."""
    return tuple(name for name in text.decode("ascii", "replace").split(",") if name)


class PackageParser:
    """Parses packages from bytes in chunks of any size; skips bytes that begin no package.

    Args:
        data_size: total size of a `U` package once known; packages of that type with another size are noise then.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.data_size: int | None = None
        self.noise = 0

    def feed(self, chunk: bytes) -> list[tuple[str, bytes]]:
        """Return `(type, payload)` of each complete package."""
        data = self._buffer + chunk
        at, found = 0, []
        while len(data) - at >= HEADER.size:
            size = self._size_at(data, at)
            if size is None or (at + size < len(data) and not self._begins_at(data, at + size)):
                at += 1
                self.noise += 1
                continue
            if at + size > len(data):
                break
            found.append((chr(data[at + 2]), data[at + HEADER.size : at + size]))
            at += size
        self._buffer = data[at:]
        return found

    def _size_at(self, data: bytes, at: int) -> int | None:
        size, kind = HEADER.unpack_from(data, at)
        if kind not in KNOWN or not HEADER.size <= size <= LONGEST:
            return None
        if kind == ord("U") and self.data_size is not None and size != self.data_size:
            return None
        return int(size)

    def _begins_at(self, data: bytes, at: int) -> bool:
        """Return whether a package could begin here, judged by the bytes known."""
        return len(data) - at < HEADER.size or self._size_at(data, at) is not None
