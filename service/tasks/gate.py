"""Gives a task access to the cell, in which a task that was cancelled or stopped can start no further motion.

When an arm fails, the stop is latched, so that no task moves the arm before a person has checked it.
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
from hal.motion import DeclaredMotion, MotionLimits, MotionReport, Mover, RobotState
from service.processes.connection import CellConnection

After = Callable[[MotionReport, Mover, MotionLimits], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class GatedMover:
    """Executes motions after a check that the task may still move.

    Attributes:
        check: raises when the task may not move any more.
        arms: names of devices whose failure stops the cell.
        stop: latches the stop; takes the reason.
        after: called with the report of each motion, the mover behind the gate and the motion's limits; see `Losses`.
    """

    mover: Mover
    check: Callable[[], None]
    arms: Collection[str] = ()
    stop: Callable[[str], object] = lambda _reason: None
    after: After = lambda _report, _mover, _limits: None

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Run the motion.

        Raises:
            Cancelled, Stopped: the task was cancelled or stopped, perhaps between two motions; nothing moved.
        """
        self.check()
        report = self.mover.execute(motion)
        if report.device in self.arms:
            self.stop(report.cause)
        self.after(report, self.mover, motion.limits)
        return report

    def cancel(self) -> None:
        """End the running motion."""
        self.mover.cancel()

    def tare(self) -> Array:
        """Zero the contact wrench; refused under the same conditions as a motion."""
        self.check()
        try:
            return self.mover.tare()
        except DeviceError as error:
            if error.details.get("device") in self.arms:
                self.stop(error.what)
            raise

    def state(self) -> RobotState:
        """Return the newest snapshot of the robot's state."""
        return self.mover.state()


class GatedConnection:
    """The cell's connection with a gated mover and the calibrations that were in use when the task began."""

    def __init__(
        self,
        connection: CellConnection,
        check: Callable[[], None],
        *,
        cell: Cell | None = None,
        stop: Callable[[str], object] = lambda _reason: None,
        after: After = lambda _report, _mover, _limits: None,
    ) -> None:
        self._connection = connection
        self._check = check
        self._cell = cell
        self._stop = stop
        self._after = after

    @property
    def cell(self) -> Cell:
        """The cell file, with records that were calibrated here in place of its own."""
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
            after=self._after,
        )

    def device(self, name: str) -> Any:
        """Return the device called `name`."""
        return self._connection.device(name)

    def devices_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return all devices of a kind by name."""
        return self._connection.devices_of(kind)

    def behind_wires_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return the devices behind the emulated wires of a kind's devices."""
        return self._connection.behind_wires_of(kind)

    def close(self) -> None:
        """Do nothing, because the connection belongs to the service and not to the task."""
