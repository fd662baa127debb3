"""What the instruments of the simulated plant show in the course of the week."""

from __future__ import annotations

import math
from dataclasses import dataclass

from service.week.files import CURRENT, FLOW, LAMP, PRESSURE, TEMPERATURE

START_BAR, RISE_BAR, RELIEVED_BAR, RELIEF_TIME = 3.6, 5.5, 4.2, 0.02
UNREADABLE_AT, DARK_AT = 0.30, 0.92  # share of the week


@dataclass(slots=True, kw_only=True)
class Story:
    """The plant by the share of the week that has passed, 0 to 1.

    The pressure rises until somebody closes the valve; the temperature follows the days. In one round the needle of the flow
    meter stands off its scale, so that it cannot be read, and at the end the plant stops and its lamp goes out.

    Attributes:
        days: length of the story.
        rounds: number of rounds in it.
        relieved_at: share at which the valve was closed; None before.
    """

    days: float
    rounds: int
    relieved_at: float | None = None

    @property
    def unreadable_round(self) -> int:
        """The round, from 0, in which the flow meter cannot be read."""
        return min(self.rounds - 1, max(0, round(UNREADABLE_AT * self.rounds)))

    def values(self, number: int, share: float) -> dict[str, float]:
        """Return what each instrument shows in a round (from 0) at a share of the week."""
        return {
            PRESSURE: self.pressure(share),
            FLOW: -24.0 if number == self.unreadable_round else 62.0 - 6.0 * share,
            CURRENT: 2.4 + 0.2 * math.sin(5.0 * share),
            TEMPERATURE: round(42.0 + 6.0 * math.sin(2.0 * math.pi * self.days * share), 1),
            LAMP: float(share < DARK_AT),
        }

    def pressure(self, share: float) -> float:
        """Return the pressure in bar: it rises evenly, and falls from the moment at which the valve was closed."""
        if self.relieved_at is None:
            return START_BAR + RISE_BAR * share
        reached = START_BAR + RISE_BAR * self.relieved_at
        return RELIEVED_BAR + (reached - RELIEVED_BAR) * math.exp(-(share - self.relieved_at) / RELIEF_TIME)
