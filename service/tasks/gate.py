"""A task's view of the cell: as the cell, but a task that was cancelled or stopped can start no further motion.

An arm that failed latches the stop: neither this task nor a later one moves it before somebody has looked at it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from hal.arrays import Array
from hal.clock import Clock
from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import DeviceError
from hal.motion import DeclaredMotion, MotionReport, Mover, RobotState
from service.processes.connection import CellConnection


@dataclass(frozen=True, slots=True, kw_only=True)
class GatedMover:
    """Checks before each motion whether the task still has the right to move.

    Attributes:
        check: raises when it has not.
        arms: names of devices whose failure stops the cell.
        stop: latches the stop, with the reason.
    """

    mover: Mover
    check: Callable[[], None]
    arms: Collection[str] = ()
    stop: Callable[[str], object] = lambda _reason: None

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Run the motion.

        Raises:
            Cancelled, Stopped: the task was, perhaps between two motions; nothing moved.
        """
        self.check()
        report = self.mover.execute(motion)
        if report.device in self.arms:
            self.stop(report.cause)
        return report

    def cancel(self) -> None:
        """End the running motion."""
        self.mover.cancel()

    def tare(self) -> Array:
        """Zero the contact wrench; refused as a motion is."""
        self.check()
        try:
            return self.mover.tare()
        except DeviceError as error:
            if error.details.get("device") in self.arms:
                self.stop(error.what)
            raise

    def state(self) -> RobotState:
        """Newest snapshot."""
        return self.mover.state()


class GatedConnection:
    """The cell's connection with a gated mover, and with the calibrations of the moment the task began."""

    def __init__(
        self,
        connection: CellConnection,
        check: Callable[[], None],
        *,
        cell: Cell | None = None,
        stop: Callable[[str], object] = lambda _reason: None,
    ) -> None:
        self._connection = connection
        self._check = check
        self._cell = cell
        self._stop = stop

    @property
    def cell(self) -> Cell:
        """The cell file, with what was calibrated here in place of its records."""
        return self._cell or self._connection.cell

    @property
    def clock(self) -> Clock:
        """The cell's clock."""
        return self._connection.clock

    @property
    def mover(self) -> Mover:
        """The gated motion port."""
        return GatedMover(
            mover=self._connection.mover,
            check=self._check,
            arms=self.cell.names_of(DeviceKind.ARM),
            stop=self._stop,
        )

    def device(self, name: str) -> Any:
        """A device."""
        return self._connection.device(name)

    def devices_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Devices of a kind."""
        return self._connection.devices_of(kind)

    def behind_wires_of(self, kind: DeviceKind) -> dict[str, Any]:
        """What answers behind emulated wires."""
        return self._connection.behind_wires_of(kind)

    def close(self) -> None:
        """Nothing: the connection belongs to the service, not to the task."""
