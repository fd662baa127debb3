"""Text of a new driver and its conformance test, made from the interface that it shall satisfy."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from pathlib import Path

from hal.devices import PROTOCOLS, DeviceKind

DRIVER = '''"""{title}: what it measures, over which wire, by which document of its maker."""

from __future__ import annotations

{imports}
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context
from hal.strict import Strict, validate


class Options(Strict):
    """Options of `{name}:{kind}` in a cell file."""

    port: str
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 50.0


class {cls}:
    """Implements `hal.devices.{protocol}`; `drivers.transport` has links, framing and reconnecting."""

    kind = DeviceKind.{kind_name}

    def __init__(self, context: Context, options: Options) -> None:
        self.name = context.name
        self._clock = context.clock
        self._options = options
        self._is_open = True

    def health(self) -> Health:
        """State of the link and the newest sample; returns at once."""
        quality = Quality.VALID if self._is_open else Quality.INVALID
        return Health(connected=self._is_open, quality=quality, cause=Cause.NONE if self._is_open else Cause.COMM)

    def close(self) -> None:
        """Release port and thread; a second call does nothing."""
        self._is_open = False
{methods}
    def _unwritten(self, method: str) -> DeviceUnavailable:
        what = f"{{self.name}}: {{method}} is not written yet"
        return DeviceUnavailable(what, hint="write it in drivers/{name}.py", device=self.name)


def connect(context: Context, options: dict[str, Any]) -> {cls}:
    """Entry point of `{name}:{kind}`.

    Raises:
        ConfigError: an option is wrong; names it.
        DeviceUnavailable: nothing answers on the port.
    """
    key = f"devices.{{context.name}}.options"
    return {cls}(context, validate(options, Options, source=key))
'''

METHOD = '''
    def {signature}:
        """See `hal.devices.{protocol}.{method}`."""
        raise self._unwritten("{method}")
'''

TEST = '''"""{cls} keeps the promises of its kind."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.{name} import connect
from hal.clock import WallClock
from hal.conformance import {contract}, Rig
from hal.registry import Context


class Test{cls}({contract}):
    """Against the far side of the wire: an emulator (see drivers/emulators) or the device itself."""

    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        device = connect(Context(name="{name}"), {{"port": "loop"}})
        yield Rig(device=device, clock=WallClock())
        device.close()
'''


def driver_files(name: str, kind: DeviceKind) -> dict[Path, str]:
    """Paths and texts of a new driver and its test."""
    protocol = PROTOCOLS[kind]
    cls = "".join(part.capitalize() for part in name.split("_"))
    own = {key: value for key, value in vars(protocol).items() if callable(value) and not key.startswith("_")}
    signatures = {key: _signature(key, value) for key, value in own.items()}
    methods = "".join(
        METHOD.format(signature=signature, protocol=protocol.__name__, method=key)
        for key, signature in signatures.items()
    )
    driver = DRIVER.format(
        title=cls, name=name, kind=kind, cls=cls, protocol=protocol.__name__, kind_name=kind.name, methods=methods,
        imports=_imports(signatures.values()),
    )  # fmt: skip
    test = TEST.format(cls=cls, name=name, contract=f"{protocol.__name__}Contract")
    return {Path("drivers") / f"{name}.py": driver, Path("tests/drivers") / f"test_{name}.py": test}


def _signature(name: str, function: object) -> str:
    """The interface's own signature, as source text."""
    signature = inspect.signature(function)  # type: ignore[arg-type]  # a method of a Protocol
    return f"{name}{signature}".replace("'", "")


def _imports(signatures: Iterable[str]) -> str:
    """Import lines for the names that the signatures use, in ruff's order."""
    import hal.devices

    used = set(re.findall(r"[A-Za-z_]+", " ".join(signatures)))
    types = {name for name in used if name[0].isupper() and hasattr(hal.devices, name)}
    own = sorted({"DeviceKind", "Health", *types} - {"Deadline", "Stamped", "Sequence", "NDArray"})
    lines = ["from collections.abc import Sequence"] if "Sequence" in used else []
    lines += ["from typing import Annotated, Any", "", "from pydantic import Field", ""]
    lines += ["from hal.clock import Deadline", f"from hal.devices import {', '.join(own)}"]
    return "\n".join([*lines, "from hal.errors import DeviceUnavailable"])
