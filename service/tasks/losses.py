"""What happens when a motion loses its client or a device: hold, go back the way it came, or stop and switch off.

The cell file chooses (`[safety]`: `client_lost`, `device_lost`, `wrench_lost`). For the loss of the service itself
(`service_lost`) the cell does the same without it. The loss of the arm, the cell or the stop process always stops and switches
off: nothing is left that could move the arm with care.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

from hal.config import Cell, LossAction
from hal.devices import DeviceKind
from hal.errors import CellError
from hal.motion import JointTrajectory, MotionLimits, MotionOutcome, MotionReport, Mover
from manipulation import Trail

log = logging.getLogger(__name__)


class Losses:
    """Carries out what the cell file chooses for each loss.

    Args:
        cell: with the choices, and with the names of the arms and force/torque sensors.
        stop: latches the stop, which also switches the drives off; takes the reason.
    """

    def __init__(self, cell: Cell, *, stop: Callable[[str], object]) -> None:
        self._safety = cell.file.safety
        self._arms: Collection[str] = cell.names_of(DeviceKind.ARM)
        self._wrists: Collection[str] = cell.names_of(DeviceKind.FORCE_TORQUE)
        self._stop = stop
        self._lock = threading.Lock()
        self._is_going_back = False
        self._without_client: deque[str] = deque(maxlen=100)

    @contextmanager
    def of_client(self, task: str, why: str) -> Iterator[None]:
        """Cancel a running motion task in this context when it has lost its client."""
        self._without_client.append(task)
        yield
        if self._safety.client_lost == "stop":
            self._stop(why)

    def followed(self, task: str, check: Callable[[], None]) -> Callable[[MotionReport, Mover, MotionLimits], None]:
        """Return what must be called with the report of each motion of a task, the mover and the motion's limits.

        Args:
            check: raises when the stop was pressed after the task was asked for, even if it was reset since.
        """
        trail = Trail()

        def after(report: MotionReport, mover: Mover, limits: MotionLimits) -> None:
            trail.add(report)
            if self._action(task, report) == "retreat" and (motion := trail.way_back(limits)) is not None:
                self._go_back(motion, mover, check)

        return after

    @contextmanager
    def cancelling(self) -> Iterator[bool]:
        """Give whether a cancellation may end the running motion: a way back is ended by the stop only."""
        with self._lock:
            yield not self._is_going_back

    def _action(self, task: str, report: MotionReport) -> LossAction:
        if report.outcome is MotionOutcome.CANCELLED and task in self._without_client:
            return self._safety.client_lost
        if report.outcome is MotionOutcome.FAULT and report.device is not None and report.device not in self._arms:
            action = self._safety.wrench_lost if report.device in self._wrists else self._safety.device_lost
            if action == "stop":
                self._stop(report.cause)
            return action
        return "hold"

    def _go_back(self, motion: JointTrajectory, mover: Mover, check: Callable[[], None]) -> None:
        with self._lock:
            self._is_going_back = True
        try:
            check()
            report = mover.execute(motion)
            log.warning("went back the way the arm had come: %s", report.cause)
        except CellError as error:  # above all the stop
            log.warning("the arm does not go back the way it came: %s", error)
        finally:
            with self._lock:
                self._is_going_back = False
