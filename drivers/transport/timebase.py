"""Converts device clocks to host time: unwraps counters, estimates the offset, stamps frames of devices without a clock."""

from __future__ import annotations

import math
from collections import deque

WINDOW_S = 0.5  # long enough to contain frames that were not late, short enough to follow an inaccurate clock
MAX_DRIFT = 0.05  # device clock against the host's; quartz has 1e-4, a software counter a few percent
QUARTZ_DRIFT = 5e-4  # below this drift no slope is estimated; the error is at most 0.4 ms
EXCHANGES = 64
REPEATED = 0.3  # fraction of a period: frames closer together than a device can send
LATELY = 8  # frames; at least one of this many was not late, and a shift of the sender is followed after this many
ALMOST = 0.1  # fraction of a period: jitter of the gap that a lost frame leaves
LATE_S, SELDOM = 5e-4, 0.2
PERIOD_OVER_S = 1.0
PAUSE_S, PAUSE_RATIO = 0.1, 1.5  # a pause lacks data for longer than this, and than this multiple of the usual interval
AT_ONCE = 0.5  # data that come in less than this fraction of the time that they took to measure were waiting
RESTART_S = 1.0  # a device clock that jumps back or differs from the expected time by this much has been restarted
LONGEST_AWAY_S = 60.0  # quartz clocks drift apart by 30 ms in that time


class Unwrapper:
    """Unwraps a counter of `bits` bits into monotonic seconds.

    Args:
        tick_s: seconds per count.
    """

    def __init__(self, *, bits: int, tick_s: float) -> None:
        self._period = 1 << bits
        self._tick_s = tick_s
        self._last: int | None = None
        self._ticks = 0

    def seconds(self, count: int) -> float:
        """Return seconds since the last zero before the first count; steps back of less than half a turn are kept."""
        if self._last is None:
            self._ticks = count
        else:
            step = (count - self._last) % self._period
            self._ticks += step - self._period if step > self._period // 2 else step
        self._last = count
        return self._ticks * self._tick_s


class HostTime:
    """Estimates the host time of device time stamps.

    A frame can arrive late but never early, so the smallest difference is the most accurate one:

    offset(t) = the line through the smallest `arrived - device` of the last two complete windows, limited to the
    difference of the current frame and of the current window. The slope of the line is the drift between the clocks.
    """

    def __init__(self) -> None:
        self._forget()

    def reset(self) -> None:
        """Prepare for a reopened device: its clock may have restarted or continued, and the first frame may be late."""
        self._is_reopened = True

    def _forget(self) -> None:
        self._is_reopened = False
        self._arrived_s = -math.inf
        self._truest: list[tuple[float, float]] = []  # (arrived, difference) of the last two complete windows
        self._running = (0.0, math.inf)
        self._window_end_s = -math.inf
        self._device_s = -math.inf

    def host_s(self, *, device_s: float, arrived_s: float) -> float:
        """Return when a sample stamped `device_s` was taken, on the clock of `arrived_s`."""
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
        """Return whether the device clock agrees with the last offset."""
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
            drift = 0.0  # a slope this small is jitter of the two differences
        return offset_s + min(max(drift, -MAX_DRIFT), MAX_DRIFT) * min(at_s - then_s, 2.0 * WINDOW_S)


class ExchangeTime:
    """Estimates when a device took the value that it returned: at some time between request and answer.

    The shortest recent exchange is the time that link and device need, and the middle of it is used. A longer exchange
    contains waiting, possibly after the value was taken, so the value is not dated later than that:

        taken = asked + min_i (answered_i - asked_i) / 2.
    """

    def __init__(self) -> None:
        self._lasted_s: deque[float] = deque(maxlen=EXCHANGES)

    def taken_s(self, asked_s: float, answered_s: float) -> float:
        """Return when the value of this exchange was taken, on the clock of both arguments."""
        self._lasted_s.append(answered_s - asked_s)
        return asked_s + 0.5 * min(self._lasted_s)


class Pauses:
    """Tells which data of a stream without a clock may have been held up on their way.

    Data that end a pause may be as old as the pause: neither their arrival nor their content shows it. The same holds for
    data that follow at once, faster than the device measures, until they have made up for the pause. A late reader is no
    pause, because all that it missed comes in one chunk.

    Args:
        longest_s: longest usual time between two items, of a device whose rate is known; without it, pauses that are
            frequent enough pass for the usual time.
    """

    def __init__(self, *, longest_s: float = math.inf) -> None:
        self._longest_s = longest_s
        self.reset()

    def reset(self) -> None:
        """Start again, because the link was reopened."""
        self._arrived_s = -math.inf
        self._intervals: deque[tuple[float, float]] = deque(maxlen=LATELY)  # between chunks, and the same per item
        self._lacking_s = 0.0

    @property
    def each_s(self) -> float | None:
        """Return the usual time between two items, or None before the second chunk."""
        if not self._intervals:
            return None
        return min(_median([each_s for _, each_s in self._intervals]), self._longest_s)

    def may_be_held_up(self, arrived_s: float, count: int) -> bool:
        """Return whether a chunk of `count` items (frames, bytes) may be older than its arrival says."""
        interval_s, each_s = arrived_s - self._arrived_s, self.each_s
        self._arrived_s = arrived_s
        if math.isinf(interval_s):
            return False
        learned_s = _median([usual_s for usual_s, _ in self._intervals]) if self._intervals else math.inf
        usual_s = min(learned_s, count * self._longest_s)
        measured_s = count * (each_s or 0.0)
        if self._lacking_s > 0.0 and interval_s < AT_ONCE * measured_s:
            self._lacking_s -= measured_s - interval_s
            return True
        self._intervals.append((interval_s, interval_s / count))
        is_pause = interval_s - measured_s > max(PAUSE_S, PAUSE_RATIO * usual_s)
        self._lacking_s = interval_s - measured_s if is_pause else 0.0
        return is_pause


class FrameTimes:
    """Stamps the frames of a device that streams without a clock, and drops repeated frames.

    The frame count serves as the clock. A frame can arrive late but never early, so from the last few arrivals a_i with
    frame numbers n_i, and the period p measured over the last second:

        stamp(n) = min_i a_i + (n - n_i) p,  at most one period before its own arrival.

    The host is rarely late. If many frames come late, the sender itself is irregular and the arrival times are used.
    Of several frames in one chunk, all but the last are older by whole periods. Frames that may have been held up are
    dropped (see `Pauses`).

    Args:
        period_s: nominal time between two frames.
        frame_bytes: length of a frame; a frame began this many byte durations before it was complete.
    """

    def __init__(self, *, period_s: float, frame_bytes: int) -> None:
        self._nominal_s = period_s
        self._frame_bytes = frame_bytes
        self._arrivals: deque[tuple[int, float]] = deque(maxlen=max(LATELY, round(PERIOD_OVER_S / period_s)))
        self._late: deque[bool] = deque(maxlen=8 * LATELY)
        self._stamped_s = -math.inf
        self._last = (b"", -math.inf)
        self._pauses = Pauses()

    def reset(self) -> None:
        """Start again, because the link was reopened."""
        self._arrivals.clear()
        self._late.clear()
        self._last = (b"", -math.inf)
        self._pauses.reset()

    def stamped(self, frames: list[bytes], *, arrived_s: float, byte_s: float) -> list[tuple[bytes, float]]:
        """Return each new frame with its time; equal frames at the same moment are one repeated frame."""
        new = []
        for frame in frames:
            if frame != self._last[0] or arrived_s - self._last[1] >= REPEATED * self._nominal_s:
                new.append(frame)
                self._last = (frame, arrived_s)
        if not new or self._pauses.may_be_held_up(arrived_s, len(new)):
            return []
        each_s, began_s = self._pauses.each_s or self._nominal_s, arrived_s - self._frame_bytes * byte_s
        ages_s = [each_s * later for later in reversed(range(len(new)))]
        return [(frame, self._stamp_s(began_s - age_s)) for frame, age_s in zip(new, ages_s, strict=True)]

    def _stamp_s(self, arrived_s: float) -> float:
        period_s, count = self._period_s(), 0
        if self._arrivals:
            gaps = (arrived_s - self._stamped_s) / period_s  # whole periods beyond the first are lost frames
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


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
