"""Dates the measurements of a scanner without a clock by the arrivals of the chunks that brought them."""

from __future__ import annotations

from collections import deque

import numpy as np

CHUNKS = 256  # the last measurements of a turn are confirmed by the next eleven, of five bytes
LATELY = 8  # chunks before the one that brought a measurement; one of so many was not late
PERIOD_OVER_S = 0.5  # over less, the jitter of the arrivals would count


class MeasurementTimes:
    """Turns numbers of measurements into times: the scanner measures at an even rate, whatever its motor does.

    A chunk k that arrives at a_k, with the measurement n_k as its last one, can be late but never early. So, with the period
    p of the measurements, which is the slope of the arrivals over their numbers,

        t(n) = min_k a_k + (n - n_k) p.
    """

    def __init__(self) -> None:
        self._chunks: deque[tuple[float, int]] = deque(maxlen=CHUNKS)

    def reset(self) -> None:
        """Start again, because data were lost."""
        self._chunks.clear()

    def add(self, arrived_s: float, received: int) -> None:
        """Take in a chunk, after which so many measurements have been received."""
        self._chunks.append((arrived_s, received))

    def taken_s(self, number: int, nominal_s: float) -> float:
        """Return when a measurement that has been received was taken; one that only a later chunk confirms, too.

        `nominal_s`: time between two measurements as long as too little has arrived to measure it.
        """
        own = next(place for place, (_, received) in enumerate(self._chunks) if received >= number)
        measured_s = self._measured_s()
        if measured_s is None:
            arrived_s, received = self._chunks[own]
            return arrived_s + (number - received) * nominal_s
        near = list(self._chunks)[max(0, own - LATELY) :]
        return min(arrived_s + (number - received) * measured_s for arrived_s, received in near)

    def _measured_s(self) -> float | None:
        arrived_s, received = np.array(self._chunks).T
        if arrived_s[-1] - arrived_s[0] < PERIOD_OVER_S or len(self._chunks) <= LATELY:
            return None
        slope = float(np.polyfit(received - received[0], arrived_s - arrived_s[0], 1)[0])
        return slope if slope > 0.0 else None
