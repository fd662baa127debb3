"""What sits in the seat of a device that did not connect, so that the rest of the cell can be used meanwhile."""

from __future__ import annotations

from typing import Any, NoReturn

from hal.devices import PROTOCOLS, DeviceKind, Health
from hal.errors import CellError
from hal.readings import Cause, Quality
from service.errors import NotConnected


class Absent:
    """Has the interface of its kind; every call says why there is no device, and how to try again.

    Args:
        error: what connecting met.
    """

    def __init__(self, name: str, kind: DeviceKind, error: CellError) -> None:
        self.name, self.kind = name, kind
        self._why = NotConnected(
            f"{name} did not connect: {error.what.removeprefix(name).lstrip(': ')}",
            hint=f"{error.hint}; then POST /v1/devices/{name}/connect",
            **{**error.details, "device": name},
        )

    def __dir__(self) -> list[str]:
        return ["name", *dir(PROTOCOLS[self.kind])]  # what a host offers to other processes

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_") or attribute not in dir(PROTOCOLS[self.kind]):
            raise AttributeError(attribute)
        return self._refuse

    def _refuse(self, *_args: Any, **_kwargs: Any) -> NoReturn:
        raise self._why

    @property
    def why(self) -> NotConnected:
        """What every call raises."""
        return self._why

    def health(self) -> Health:
        """Not connected, and why."""
        return Health(connected=False, quality=Quality.INVALID, cause=Cause.COMM, detail=self._why.what)

    def close(self) -> None:
        """Nothing to close."""
