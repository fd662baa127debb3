"""An emulator puts any HAL device on a wire: it answers a real protocol with what the device behind it says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from hal.devices import Device


class Emulator(Protocol):
    """The far side of a wire, running."""

    @property
    def address(self) -> dict[str, Any]:
        """Options that make the real driver find this emulator, e.g. `{"host": "127.0.0.1", "port": 15020}`."""
        ...

    def close(self) -> None:
        """End thread and port; a second call does nothing."""
        ...


EmulatorFactory = Callable[[Device, dict[str, Any]], Emulator]
"""Entry point in group `panelwright.emulators`: `start(backing, options) -> Emulator`."""
