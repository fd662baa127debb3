"""The arm's drives as the control thread uses them: switched on and off, and held by set-points at an even rate."""

from __future__ import annotations

import logging

from hal.arrays import Array
from hal.clock import Clock, Deadline, WallClock
from hal.devices import Arm
from hal.errors import CellError
from manipulation.control.sensing import command_wait_s, failure_of, read_wait_s

log = logging.getLogger(__name__)


class Drives:
    """Switches the drives and sends set-points, one per period of `dt_s`."""

    def __init__(self, arm: Arm, clock: Clock, dt_s: float) -> None:
        self.dt_s = dt_s
        self.are_on = False
        self._arm = arm
        self._clock = clock
        self._next_tick_s = clock.now_s()

    def switch_on(self) -> None:
        """Switch the drives on.

        Raises:
            DeviceFailure: the arm refuses or does not answer.
        """
        try:
            self._arm.enable(deadline=Deadline.after(self._clock, command_wait_s(self._clock)))
        except Exception as error:
            raise failure_of(self._arm.name, error) from error
        self.are_on = True

    def switch_off(self) -> str | None:
        """Switch the drives off if they are on, because the stop is latched or the arm does not answer; see `stop`."""
        why = self.stop() if self.are_on else None
        self.are_on = False
        return why

    def stop(self) -> str | None:
        """Ask the arm to stop in any state; returns why it did not, None if it did.

        An arm that does not receive this stops by its own watchdog.
        """
        try:
            self._arm.stop(deadline=Deadline.after(self._clock, command_wait_s(self._clock)))
        except CellError as error:
            return f"{self._arm.name}: {error.what}"
        except Exception as defect:  # a defect of the driver must not keep the caller from stopping the rest
            log.exception("stopping %s", self._arm.name)
            return f"{self._arm.name}: {type(defect).__name__}: {defect}"
        return None

    def send(self, position_rad: Array) -> Array:
        """Send a set-point (n,), rad, and return the one that the arm accepted.

        Raises:
            DeviceFailure: the arm refuses or does not answer.
        """
        try:
            deadline = Deadline(self._clock.now_s() + read_wait_s(self._clock), self._clock)
            return self._arm.command_position(position_rad, deadline=deadline)
        except Exception as error:
            raise failure_of(self._arm.name, error) from error

    def begin_rhythm(self) -> None:
        """Start counting periods from now."""
        self._next_tick_s = self._clock.now_s()

    def pass_tick(self) -> None:
        """Wait until the next period begins; a simulated world makes its steps meanwhile."""
        if not isinstance(self._clock, WallClock):
            self._clock.sleep(self.dt_s)
            return
        now_s = self._clock.now_s()
        # After a late tick the periods are counted from now, because catching up would send several set-points at once.
        self._next_tick_s = max(self._next_tick_s + self.dt_s, now_s)
        self._clock.sleep(self._next_tick_s - now_s)
