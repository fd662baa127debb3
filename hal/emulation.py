"""Interface of an emulator, which offers any HAL device by a real protocol, so that a real driver can use it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from hal.devices import Device


class Emulator(Protocol):
    """Running emulator at the other end of a driver's link."""

    @property
    def address(self) -> dict[str, Any]:
        """Driver options that make the real driver find this emulator, e.g. `{"host": "127.0.0.1", "port": 15020}`."""
        ...

    def close(self) -> None:
        """End the thread and close the port; a second call does nothing."""
        ...


EmulatorFactory = Callable[[Device, dict[str, Any]], Emulator]
"""Entry point in group `panelwright.emulators`: `start(backing, options) -> Emulator`."""
