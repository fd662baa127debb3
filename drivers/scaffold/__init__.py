"""Generates a new driver that runs at once: driver, emulator, test and documentation page, to be adapted to the device.

The generated driver is for an invented device that streams frames `A5 5A counter values.. sum`, with values in
thousandths of the SI unit. `panelwright new-driver` finds this module by the entry point `panelwright.scaffold`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from drivers.scaffold.kinds import KINDS, Imports, KindText
from drivers.scaffold.templates import DRIVER, EMULATOR, PAGE, PROJECT, README, TEST
from hal.devices import DeviceKind
from hal.errors import ConfigError

__all__ = ["entry_points", "new_driver"]

Transport = Literal["serial", "tcp"]
NAME = re.compile(r"^[a-z][a-z0-9_]{0,40}$")
LINE = 120
WIRES: dict[str, dict[str, str]] = {
    "serial": {"options_base": "SerialOptions", "opener": "serial_opener", "port": "PtyPort"},
    "tcp": {"options_base": "TcpOptions", "opener": "tcp_opener", "port": "TcpPort"},
}


def new_driver(
    name: str, kind: DeviceKind, *, transport: Transport = "serial", package: str | None = None
) -> dict[Path, str]:
    """Return the texts of a driver, its emulator, its test and its page by their relative paths; nothing is written.

    Args:
        name: module name: lower-case letters, digits and underscores.
        package: name of a separate package, with the emulator beside the driver and a `pyproject.toml`; None for files
            in this source tree.

    Raises:
        ConfigError: the name is not valid, or there is no template for the kind or the transport.
    """
    for word in (name, package or name):
        if not NAME.fullmatch(word):
            raise ConfigError(f"{word!r} is not a module name", hint="use lower-case letters, digits and underscores")
    if kind not in KINDS:
        hint = (
            f"templates: {', '.join(KINDS)}; for other kinds begin with a copy of the most similar driver in drivers/"
        )
        raise ConfigError(f"there is no template for kind {kind}", hint=hint)
    if transport not in WIRES:
        raise ConfigError(f"there is no template for {transport!r}", hint=f"transports: {', '.join(WIRES)}")
    words = _words(name, kind, transport, package)
    is_own = package is not None
    files = {
        _path(words["driver"]): DRIVER.substitute(words),
        _path(words["far_side"]): EMULATOR.substitute(words),
        Path("tests" if is_own else "tests/drivers") / f"test_{name}.py": TEST.substitute(words),
    }
    if package is None:
        return {**files, Path("docs") / f"driver_{name}.md": PAGE.substitute(words)}
    return {
        Path(package) / "__init__.py": f'"""{words["title"].capitalize()} for panelwright."""\n',
        **files,
        Path("README.md"): PAGE.substitute(words) + README.substitute(words),
        Path("pyproject.toml"): PROJECT.substitute(words),
    }


def entry_points(name: str, transport: Transport) -> dict[str, str]:
    """Return the lines that register a driver of this source tree, by the header of their table in `pyproject.toml`."""
    return {
        '[project.entry-points."panelwright.devices"]': f'"{transport}:{name}" = "drivers.{name}:connect"',
        '[project.entry-points."panelwright.emulators"]': f'{name} = "drivers.emulators.{name}:start"',
    }


def _path(module: str) -> Path:
    return Path(*module.split(".")).with_suffix(".py")


def _words(name: str, kind: DeviceKind, transport: Transport, package: str | None) -> dict[str, str]:
    k, wire = KINDS[kind], WIRES[transport]
    driver = f"{package or 'drivers'}.{name}"
    far_side = f"{package}.{name}_emulator" if package else f"drivers.emulators.{name}"
    cls = "".join(part.capitalize() for part in name.split("_"))
    return {
        "name": name,
        "cls": cls,
        "title": name.replace("_", " "),
        "kind": str(kind),
        "transport": transport,
        "package": package or "drivers",
        "project": (package or "").replace("_", "-"),
        "driver": driver,
        "far_side": far_side,
        "protocol": k.protocol,
        "contract": k.contract,
        "read": k.read,
        "base": k.base,
        "members": k.members,
        "methods": k.methods,
        "count": str(k.count),
        "code": k.code,
        "rate_hz": str(k.rate_hz),
        "constants": k.constants,
        "decode": k.decode,
        "encode": k.encode,
        "publish": k.publish,
        "far_methods": k.far_methods,
        "stand_in": k.stand_in,
        "port_made": f'PtyPort("{name}")' if transport == "serial" else "TcpPort()",
        **wire,
        **_imports(k, wire, driver, far_side),
    }


def _imports(k: KindText, wire: Mapping[str, str], driver: str, far_side: str) -> dict[str, str]:
    """Return the import blocks of driver, emulator and test."""
    own: Imports = {
        "struct": (),
        "typing": ("Any",),
        "drivers.transport.checks": ("sum_low_byte",),
        "drivers.transport.framing": ("Framer",),
        "drivers.transport.link": ("Link", "drain"),
        "drivers.transport.options": (wire["options_base"], wire["opener"], "read_options"),
        "drivers.transport.timebase": ("FrameTimes",),
        "hal.registry": ("Context", "takes"),
    }
    far: Imports = {
        "typing": ("Any",),
        "drivers.emulators.base": ("WireEmulator",),
        "drivers.emulators.faults": ("FaultOptions",),
        "drivers.emulators.ports": (wire["port"],),
        "drivers.transport.checks": ("sum_low_byte",),
        "hal.devices": ("Device", k.protocol),
        "hal.errors": ("Unsupported",),
        "hal.strict": ("validate",),
        driver: ("FRAME", "HEADER", "RATE_HZ"),
    }
    far_extra = {driver if module == "$driver" else module: names for module, names in k.far_imports.items()}
    test: Imports = {
        "collections.abc": ("Iterator",),
        "itertools": ("pairwise",),
        "typing": ("Any",),
        "pytest": (),
        "drivers.emulators.scripted": (k.stand_in,),
        "hal.clock": ("Deadline", "WallClock"),
        "hal.conformance": (k.contract, "Rig"),
        "hal.registry": ("Context",),
        driver: ("connect",),
        far_side: ("start",),
    }
    others = (
        () if driver.startswith("drivers.") else (driver.partition(".")[0],)
    )  # in a separate package the tests import the driver as third-party code
    return {
        "imports": import_lines([own, k.imports]),
        "far_imports": import_lines([far, far_extra]),
        "test_imports": import_lines([test], others),
    }


def import_lines(parts: Iterable[Imports], others: Sequence[str] = ()) -> str:
    """Return import statements in the order of ruff's isort: standard library, third party, this project."""
    names: dict[str, set[str]] = {}
    for part in parts:
        for module, wanted in part.items():
            names.setdefault(module, set()).update(wanted)
    blocks: list[list[str]] = [[], [], []]
    for module in sorted(names, key=lambda m: (bool(names[m]), m)):
        blocks[_section(module, others)].append(_import_line(module, names[module]))
    return "\n\n".join("\n".join(block) for block in blocks if block)


def _section(module: str, others: Sequence[str]) -> int:
    root = module.partition(".")[0]
    return 0 if root in sys.stdlib_module_names else 1 if root in ("numpy", "pytest", *others) else 2


def _import_line(module: str, names: set[str]) -> str:
    if not names:
        return "import numpy as np" if module == "numpy" else f"import {module}"
    ordered = sorted(names, key=lambda n: (not n.isupper(), not n[0].isupper(), n))
    line = f"from {module} import {', '.join(ordered)}"
    if len(line) <= LINE:
        return line
    return "\n".join([f"from {module} import (", *(f"    {n}," for n in ordered), ")"])
