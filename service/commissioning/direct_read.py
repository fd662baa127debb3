"""Reads one device of a cell in this process, without a service, while it is being wired or tested.

Only this device is connected, and only its own emulator is started, so the other devices of the cell may be absent.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from types import MappingProxyType
from typing import Any

from hal.clock import Clock, Deadline
from hal.config import Cell
from hal.devices import DeviceKind, RangeImage
from hal.errors import CellError, ConfigError
from hal.readings import Stamped
from hal.registry import Context, Shared
from hal.registry import connect as connect_device
from service.jsonable import jsonable
from service.processes.cell import clock_for, start_emulators
from service.readings import READS, described

CONNECT_ATTEMPTS = 3  # after three connections without a sample the device counts as absent
LOOK_AGAIN_S = 0.0005
ERROR_REST_S = 0.02  # limits the rate of errors from an absent device


@contextmanager
def device_alone(
    cell: Cell, name: str, more_options: Mapping[str, Any] = MappingProxyType({})
) -> Iterator[tuple[Callable[[], Any], Clock, dict[str, Any]]]:
    """Yield a function that connects the device `name`, its clock and its options; its emulator runs meanwhile, if any.

    Args:
        more_options: options in addition to those of the cell file.

    Raises:
        ConfigError: the cell has no such device, or its options are wrong.
    """
    section = cell.file.devices.get(name)
    if section is None:
        raise ConfigError(f"{cell.path} has no device {name!r}", hint=f"devices: {', '.join(cell.file.devices)}")
    own = {key: emulator for key, emulator in cell.file.emulators.items() if key == name}
    alone = cell.model_copy(update={"file": cell.file.model_copy(update={"emulators": own})})
    shared, clock = Shared(), clock_for(cell)
    closers: list[Callable[[], None]] = [shared.close]
    try:
        far_side = start_emulators(alone, clock, shared, closers).get(name)
        address = {} if far_side is None else far_side.address
        options = {**section.options, **address}

        def connect() -> Any:
            context = Context(name=name, clock=clock, cell=cell, shared=shared)
            return connect_device(context, section.driver, {**options, **more_options})

        yield connect, clock, options
    finally:
        for close in closers[::-1]:
            close()


def read_lines(cell: Cell, name: str, *, samples: int, timeout_s: float) -> Iterator[dict[str, Any]]:
    """Yield one JSON object per new sample, and one per call or connection that failed.

    A sample has `value`, `sequence`, `host_time_s` (monotonic), `host_unix_s`, `device_time_s`, `age_s`, `quality`,
    `cause` and `took_s`, the duration of the call. An error has `error` with `type`, `what`, `hint` and `details`.

    Args:
        timeout_s: deadline of each call.
    """
    kind = cell.file.devices[name].kind if name in cell.file.devices else DeviceKind.ARM
    with device_alone(cell, name) as (connect, clock, _):
        left = samples
        for _ in range(CONNECT_ATTEMPTS):
            started_s = time.monotonic()
            try:
                device = connect()
            except ConfigError:
                raise
            except CellError as error:
                left -= 1
                yield _error(name, kind, error, time.monotonic() - started_s)
                if left <= 0:
                    return
                continue
            try:
                yield from islice(samples_of(device, name, kind, clock, timeout_s), left)
            finally:
                device.close()
            return


def samples_of(device: Any, name: str, kind: DeviceKind, clock: Clock, timeout_s: float) -> Iterator[dict[str, Any]]:
    """Yield new samples and errors of a connected device endlessly, in the format of `read_lines`."""
    read, last = getattr(device, READS[kind]), -1
    for started_s in iter(time.monotonic, None):
        deadline = Deadline.after(clock, timeout_s)
        try:
            while (stamped := read(deadline=deadline)).sequence == last and not deadline.is_past():
                clock.sleep(LOOK_AGAIN_S)
        except CellError as error:
            yield _error(name, kind, error, time.monotonic() - started_s)
            clock.sleep(ERROR_REST_S)
            continue
        last = stamped.sequence
        yield _sample(name, kind, stamped, clock, time.monotonic() - started_s)


def _sample(name: str, kind: DeviceKind, stamped: Stamped[Any], clock: Clock, took_s: float) -> dict[str, Any]:
    age_s = stamped.age_s(clock.now_s())
    value = stamped.value
    return {
        "device": name,
        "kind": str(kind),
        "value": {"depth_m": jsonable(value.depth_m)} if isinstance(value, RangeImage) else described(value),
        "sequence": stamped.sequence,
        "host_time_s": stamped.host_time_s,
        "host_unix_s": time.time() - age_s,
        "device_time_s": jsonable(stamped.device_time_s),
        "age_s": jsonable(age_s),
        "quality": str(stamped.quality),
        "cause": str(stamped.cause),
        "detail": stamped.detail,
        "took_s": took_s,
    }


def _error(name: str, kind: DeviceKind, error: CellError, took_s: float) -> dict[str, Any]:
    told = {"type": error.type_name, "what": error.what, "hint": error.hint, "details": jsonable(error.details)}
    return {"device": name, "kind": str(kind), "error": told, "took_s": took_s}


def as_line(item: dict[str, Any]) -> str:
    """Return the item as one line of JSON."""
    return json.dumps(item, allow_nan=False) + "\n"
