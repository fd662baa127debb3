"""Where the processes of a service find the recorder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from service.recording.sender import Sender

Report = Callable[[str, dict[str, Any]], None]


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address and key (hexadecimal) of the recorder's process."""

    address: str
    key: str

    def sender(self, report: Report, *, waits: bool = False) -> Sender:
        """Return a sender to the recorder.

        Args:
            waits: see `Sender`.

        Raises:
            DeviceUnavailable: the recorder's process has ended.
        """
        from hal.host import connect
        from service.recording.sender import Sender

        recorder = connect(self.address, bytes.fromhex(self.key), "recorder", gone_hint="see the log above")
        return Sender(recorder.take, report=report, waits=waits)
