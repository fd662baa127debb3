"""Device clocks on the host's: unwrapping counters and estimating the offset."""

from __future__ import annotations

import math

WINDOW_S = 2.0  # quartz clocks drift 0.2 ms apart in this time at 100 ppm
RESTART_S = 1.0  # a device clock this far behind itself has been restarted


class Unwrapper:
    """A counter of `bits` bits to steadily growing seconds.

    Args:
        tick_s: seconds a count.
    """

    def __init__(self, *, bits: int, tick_s: float) -> None:
        self._period = 1 << bits
        self._tick_s = tick_s
        self._last: int | None = None
        self._ticks = 0

    def seconds(self, count: int) -> float:
        """Seconds since the counter's zero before it was first seen; steps back of less than half a turn stay so."""
        if self._last is None:
            self._ticks = count
        else:
            step = (count - self._last) % self._period
            self._ticks += step - self._period if step > self._period // 2 else step
        self._last = count
        return self._ticks * self._tick_s


class HostTime:
    """Host time of device stamps. A frame can arrive late but never early, so the smallest difference is the truest:

    offset = min(arrived - device) over the last one to two windows, which lets two clocks drift apart.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The device was opened anew: its clock may have started again."""
        self._before_s = self._now_s = math.inf
        self._window_end_s = -math.inf
        self._device_s = -math.inf

    def host_s(self, *, device_s: float, arrived_s: float) -> float:
        """When a sample stamped `device_s` was taken, on the clock of `arrived_s`."""
        if device_s < self._device_s - RESTART_S:
            self.reset()
        self._device_s = device_s
        if arrived_s > self._window_end_s:
            self._before_s, self._now_s = self._now_s, math.inf
            self._window_end_s = arrived_s + WINDOW_S
        self._now_s = min(self._now_s, arrived_s - device_s)
        return device_s + min(self._before_s, self._now_s)
