"""Records the traffic of one device of a cell, and replays a recording without a service and without the device."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.clock import WallClock
from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import CellError, ConfigError
from hal.registry import Context, connect
from service.commissioning.direct_read import device_alone, samples_of
from service.jsonable import jsonable

ABOUT = "about"  # kind of the line that describes the device; the drivers ignore it


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The device of a recording: the data with which the same driver can read the recording again."""

    device: str
    kind: DeviceKind
    driver: str
    options: dict[str, Any]


def record(
    cell: Cell, name: str, path: Path, *, duration_s: float, timeout_s: float
) -> Generator[dict[str, Any], None, None]:
    """Write all traffic of the device `name` to `path` for `duration_s`; yields its samples and errors meanwhile.

    Args:
        timeout_s: deadline of each reading.

    Raises:
        ConfigError: the cell has no such device, the device has no wire, or the file exists or cannot be written.
        DeviceError: the device did not connect.
    """
    if path.exists():
        raise ConfigError(f"{path} exists already", hint="choose another name, or remove it; nothing was written")
    with device_alone(cell, name, {"capture": str(path)}) as (connect_it, clock, options):
        section = cell.file.devices[name]
        line = {"dir": ABOUT, "device": name, "kind": section.kind, "driver": section.driver, "options": options}
        header = json.dumps(jsonable(line)) + "\n"
        try:
            path.write_text(header, encoding="ascii")
        except OSError as error:
            raise ConfigError(f"{path} cannot be written: {error}", hint="name a file in a folder of yours") from error
        try:
            device = connect_it()
        except CellError as error:
            if path.stat().st_size == len(header):  # no traffic was recorded; the next attempt can use the name
                path.unlink()
            if not isinstance(error, ConfigError) or "capture" not in error.what:
                raise
            what = f"{name}: {section.driver} has no wire that could be recorded"
            hint = f"`panelwright devices read {name} --jsonl` writes down its readings"
            raise ConfigError(what, hint=hint, device=name) from error
        try:
            yield from _until(samples_of(device, name, section.kind, clock, timeout_s), duration_s)
        finally:
            device.close()


def replay(path: Path, *, timeout_s: float) -> Iterator[dict[str, Any]]:
    """Yield the samples and errors that the recorded device's driver reads from the recording, at its original pace.

    Raises:
        ConfigError: the file is not a recording of a device.
        DeviceError: the driver finds no samples in it.
    """
    about, clock = read_about(path), WallClock()
    device = connect(Context(name=about.device, clock=clock), about.driver, {**about.options, "replay": str(path)})
    try:
        for item in samples_of(device, about.device, about.kind, clock, timeout_s):
            if item.get("error", {}).get("details", {}).get("recording") == "ended":
                return
            yield item
    finally:
        device.close()


def read_about(path: Path) -> About:
    """Read which device a recording belongs to.

    Raises:
        ConfigError: the file does not name a device.
    """
    hint = "give a file that `panelwright devices record` has written"
    try:
        with path.open(encoding="ascii") as file:
            line = json.loads(file.readline())
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}", hint=hint) from error
    except ValueError as error:
        raise ConfigError(f"{path} is not a recording: its first line is not JSON", hint=hint) from error
    try:
        return About(
            device=str(line["device"]),
            kind=DeviceKind(line["kind"]),
            driver=str(line["driver"]),
            options=dict(line["options"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path} does not say whose traffic it holds ({error!r})", hint=hint) from error


def _until(items: Iterator[dict[str, Any]], duration_s: float) -> Iterator[dict[str, Any]]:
    """Yield items for `duration_s` of wall time, because the clock of a mixed cell may run slower than its wires."""
    clock = WallClock()
    end_s = clock.now_s() + duration_s
    for item in items:
        yield item
        if clock.now_s() >= end_s:
            return
