"""A task without the right to move can neither begin a motion nor zero the wrench."""

from __future__ import annotations

from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hal.errors import Cancelled, DeviceFault
from hal.motion import Hold
from service.tasks.gate import GatedMover


class Counting:
    """Mover that counts its calls."""

    def __init__(self, failed: str | None = None) -> None:
        self.asked: list[str] = []
        self.failed = failed

    def execute(self, motion: Hold) -> Any:
        self.asked.append(motion.name)
        return SimpleNamespace(device=self.failed, cause=f"{self.failed} failed")

    def tare(self) -> np.ndarray:
        self.asked.append("tare")
        if self.failed:
            raise DeviceFault(f"{self.failed} failed", hint="look", device=self.failed)
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


@pytest.mark.parametrize(("failed", "stops"), [("arm", ["arm failed"]), ("wrist_ft", []), (None, [])])
@pytest.mark.parametrize("act", ["execute", "tare"])
def test_an_arm_that_failed_latches_the_stop_and_no_other_device_does(
    failed: str | None, stops: list[str], act: str
) -> None:
    behind: Any = Counting(failed)
    told: list[str] = []
    gate = GatedMover(mover=behind, check=lambda: None, arms=("arm",), stop=told.append)
    with suppress(DeviceFault):
        gate.execute(Hold(name="hold", duration_s=0.1)) if act == "execute" else gate.tare()
    assert told == stops
