"""Device clocks on the host's: unwrapping counters and estimating the offset."""

from __future__ import annotations

DRIFT = 200e-6  # two free quartz clocks; the estimate may rise this fast, so one early frame is not believed for ever
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

    offset_k = min(arrived - device, offset_{k-1} + DRIFT dt)
    """

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._device_s = 0.0

    def host_s(self, *, device_s: float, arrived_s: float) -> float:
        """When a sample stamped `device_s` was taken, on the clock of `arrived_s`."""
        delay_s = arrived_s - device_s
        if self._offset_s is None or device_s < self._device_s - RESTART_S:
            self._offset_s = delay_s
        else:
            self._offset_s = min(delay_s, self._offset_s + DRIFT * max(0.0, device_s - self._device_s))
        self._device_s = device_s
        return device_s + self._offset_s

    def reset(self) -> None:
        """The device was opened anew: its clock may have started again."""
        self._offset_s = None
