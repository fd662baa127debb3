"""Device clocks on the host's: unwrapping counters, estimating the offset, stamping frames of devices without a clock."""

from __future__ import annotations

import math
from collections import deque

WINDOW_S = 0.5  # long enough to hold some frames that were not late, short enough to follow a clock that runs badly
MAX_DRIFT = 0.05  # of a device's clock against the host's; quartz has 1e-4, a clock counted in software some percent
QUARTZ_DRIFT = 5e-4  # below this no slope is drawn: it costs 0.4 ms at most
EXCHANGES = 64
REPEATED = 0.3  # of a period: nearer together than a device can send
LATELY = 8  # frames: one of so many was not late; a talker that has shifted is followed after so many
ALMOST = 0.1  # of a period: the jitter of a gap that a lost frame has left
LATE_S, SELDOM = 5e-4, 0.2
PERIOD_OVER_S = 1.0
PAUSE_S, PAUSE_RATIO = 0.1, 3.0  # a pause lasts longer, and as many times longer than the shortest gap lately
RESTART_S = 1.0  # a device clock this far behind itself, or off what is expected, has been restarted
LONGEST_AWAY_S = 60.0  # quartz clocks part by 30 ms in that time


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

    offset(t) = the line through the smallest `arrived - device` of the last two whole windows, and never more than the
    difference of the frame at hand or of the window that runs. The line's slope is the drift of the two clocks.
    """

    def __init__(self) -> None:
        self._forget()

    def reset(self) -> None:
        """The device was opened anew: its clock may have started again, or go on, and the first frame may be late."""
        self._is_reopened = True

    def _forget(self) -> None:
        self._is_reopened = False
        self._arrived_s = -math.inf
        self._truest: list[tuple[float, float]] = []  # (arrived, difference) of the last two whole windows
        self._running = (0.0, math.inf)
        self._window_end_s = -math.inf
        self._device_s = -math.inf

    def host_s(self, *, device_s: float, arrived_s: float) -> float:
        """When a sample stamped `device_s` was taken, on the clock of `arrived_s`."""
        if device_s < self._device_s - RESTART_S or (self._is_reopened and not self._goes_on(device_s, arrived_s)):
            self._forget()
        self._is_reopened = False
        self._device_s, self._arrived_s = device_s, arrived_s
        if arrived_s > self._window_end_s:
            if self._running[1] < math.inf:
                self._truest = [*self._truest[-1:], self._running]
            self._running = (arrived_s, math.inf)
            self._window_end_s = arrived_s + WINDOW_S
        difference_s = arrived_s - device_s
        if difference_s < self._running[1]:
            self._running = (arrived_s, difference_s)
        return device_s + min(difference_s, self._line_s(arrived_s))

    def _goes_on(self, device_s: float, arrived_s: float) -> bool:
        """Does the clock still say what the last offset lets expect?"""
        beyond_s = arrived_s - device_s - self._line_s(self._arrived_s)
        return arrived_s - self._arrived_s < LONGEST_AWAY_S and -RESTART_S < beyond_s < RESTART_S

    def _line_s(self, at_s: float) -> float:
        if not self._truest:
            return self._running[1]
        (then_s, offset_s), drift = self._truest[-1], 0.0
        if len(self._truest) == 2:
            before_s, before_offset_s = self._truest[0]
            drift = (offset_s - before_offset_s) / max(then_s - before_s, 1e-3)
        if abs(drift) < QUARTZ_DRIFT:
            drift = 0.0  # what such a slope shows is the jitter of the two differences
        return offset_s + min(max(drift, -MAX_DRIFT), MAX_DRIFT) * min(at_s - then_s, 2.0 * WINDOW_S)


class ExchangeTime:
    """When a device that is asked has taken what it answers: somewhere between request and answer.

    The shortest exchange lately is what wire and device need, and the middle of that is taken. One that lasted longer has
    waited, maybe after the value was taken, so that of the later part nothing is claimed:

        taken = asked + min_i (answered_i - asked_i) / 2.
    """

    def __init__(self) -> None:
        self._lasted_s: deque[float] = deque(maxlen=EXCHANGES)

    def taken_s(self, asked_s: float, answered_s: float) -> float:
        """When the value of this exchange was taken, on the clock of both."""
        self._lasted_s.append(answered_s - asked_s)
        return asked_s + 0.5 * min(self._lasted_s)


class FrameTimes:
    """Stamps for the frames of a talker without a clock, and none for repeated frames.

    Its count of frames is the clock. A frame can arrive late but never early, so of the last few arrivals a_i, frame
    number n_i, with the period p measured over the last second:

        stamp(n) = min_i a_i + (n - n_i) p,  at most one period before its own arrival.

    This host is late seldom. Where many frames come late, the talker itself is irregular and its arrivals are the truth.
    The frame that ends a pause may be as old as that, and nothing tells: it is left out, and the next one counts.

    Args:
        period_s: nominal time between two frames.
        frame_bytes: length of a frame; it began that much line time before it was complete.
    """

    def __init__(self, *, period_s: float, frame_bytes: int) -> None:
        self._nominal_s = period_s
        self._frame_bytes = frame_bytes
        self._arrivals: deque[tuple[int, float]] = deque(maxlen=max(LATELY, round(PERIOD_OVER_S / period_s)))
        self._late: deque[bool] = deque(maxlen=8 * LATELY)
        self._stamped_s = -math.inf
        self._last = (b"", -math.inf)
        self._gaps_s: deque[float] = deque(maxlen=LATELY)

    def reset(self) -> None:
        """The wire was opened anew."""
        self._arrivals.clear()
        self._late.clear()
        self._last = (b"", -math.inf)
        self._gaps_s.clear()

    def stamped(self, frames: list[bytes], *, arrived_s: float, byte_s: float) -> list[tuple[bytes, float]]:
        """Each new frame with its time; the same bytes at the same moment are one frame that was repeated."""
        fresh = []
        for frame in frames:
            if frame == self._last[0] and arrived_s - self._last[1] < REPEATED * self._nominal_s:
                continue
            ends_pause = self._ends_pause(arrived_s)
            self._last = (frame, arrived_s)
            if ends_pause:
                continue
            fresh.append((frame, self._stamp_s(arrived_s - self._frame_bytes * byte_s)))
        return fresh

    def _ends_pause(self, arrived_s: float) -> bool:
        gap_s, shortest_s = arrived_s - self._last[1], min(self._gaps_s, default=math.inf)
        self._gaps_s.append(gap_s)
        return gap_s > max(PAUSE_S, PAUSE_RATIO * shortest_s)

    def _stamp_s(self, arrived_s: float) -> float:
        period_s, count = self._period_s(), 0
        if self._arrivals:
            gaps = (arrived_s - self._stamped_s) / period_s  # whole ones beyond the first are lost frames
            count = self._arrivals[-1][0] + max(1, math.floor(gaps + ALMOST))
        self._arrivals.append((count, arrived_s))
        lately = list(self._arrivals)[-LATELY:]
        earliest_s = min(then_s + (count - then) * period_s for then, then_s in lately)
        self._stamped_s = max(earliest_s, arrived_s - period_s)
        self._late.append(arrived_s - self._stamped_s > LATE_S)
        return arrived_s if sum(self._late) > SELDOM * len(self._late) else self._stamped_s

    def _period_s(self) -> float:
        if len(self._arrivals) < 4 * LATELY:
            return self._nominal_s
        (first, first_s), (last, last_s) = self._arrivals[0], self._arrivals[-1]
        measured_s = (last_s - first_s) / (last - first)
        return min(max(measured_s, 0.8 * self._nominal_s), 1.25 * self._nominal_s)
