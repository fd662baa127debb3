"""A task without the right to move begins no motion, and does not zero the wrench either."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hal.errors import Cancelled
from hal.motion import Hold
from service.tasks.gate import GatedMover


class Counting:
    """A mover that counts what reaches it."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def execute(self, motion: Hold) -> str:
        self.asked.append(motion.name)
        return "done"

    def tare(self) -> np.ndarray:
        self.asked.append("tare")
        return np.zeros(6)


def test_what_is_refused_reaches_no_motor() -> None:
    def refuse() -> None:
        raise Cancelled("the task was cancelled", hint="start it again")

    behind: Any = Counting()
    for check, reached in ((refuse, []), (lambda: None, ["hold", "tare"])):
        gate = GatedMover(mover=behind, check=check)
        for act in (lambda gate=gate: gate.execute(Hold(name="hold", duration_s=0.1)), gate.tare):
            if reached:
                act()
            else:
                with pytest.raises(Cancelled):
                    act()
        assert behind.asked == reached
