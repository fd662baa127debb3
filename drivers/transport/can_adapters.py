"""Finds the CAN adapters of this machine, in a child process: `python -m drivers.transport.can_adapters`.

Loading the libraries of two dozen makers can print, hang or crash, which must not reach the caller.
"""

from __future__ import annotations

import json
import os
import subprocess
from contextlib import suppress
from typing import Any

from hal.child_python import module_command

SEARCH_S, ONE_S = 10.0, 2.0
NOT_SEARCHED = frozenset(
    {"panelwright_slcan", "serial", "slcan", "socketcand", "udp_multicast", "virtual"}
)  # serial ports, which are listed as such, and networks, where anything can be
FIRST = ("socketcan", "pcan", "kvaser", "gs_usb", "ixxat", "vector")


def find_adapters(*, within_s: float = SEARCH_S) -> list[dict[str, Any]]:
    """Return `interface`, `channel` and further options of the adapters found; after `within_s` the search is ended."""
    command = module_command("drivers.transport.can_adapters")
    try:
        child = subprocess.run(  # noqa: S603 - our own interpreter and code
            command, check=False, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=within_s
        )
    except subprocess.TimeoutExpired as ended:
        return read_findings(ended.stdout or b"")
    return read_findings(child.stdout)


def read_findings(told: bytes) -> list[dict[str, Any]]:
    """Return the adapters that the child process has told, one JSON object per line; a line cut short is left out."""
    found = []
    for line in told.splitlines():
        with suppress(ValueError):
            found.append(json.loads(line))
    return found


def plain(config: dict[str, Any]) -> dict[str, Any]:
    """Return what a cell file can hold of the arguments for an adapter."""
    return {key: value for key, value in config.items() if isinstance(value, str | int | float | bool)}


def main() -> None:
    """Print each adapter as a line of JSON."""
    told = os.dup(1)
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123  # a descriptor is needed
        os.dup2(nowhere.fileno(), 1)  # libraries print to the standard output
    import can

    others = sorted(set(can.VALID_INTERFACES) - NOT_SEARCHED - set(FIRST))
    for interface in (*FIRST, *others):
        with suppress(Exception):  # what one maker's library raises must not hide the other adapters
            for config in can.detect_available_configs(interface, timeout=ONE_S):
                os.write(told, json.dumps(plain(dict(config))).encode() + b"\n")
    os._exit(0)  # a search that hangs in a library would keep the process alive


if __name__ == "__main__":
    main()
