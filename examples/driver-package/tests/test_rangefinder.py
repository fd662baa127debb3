"""Rangefinder keeps the promises of its kind, over a whole wire and over a damaged one."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from acme_rangefinder.rangefinder import connect
from acme_rangefinder.rangefinder_emulator import start

from drivers.emulators.scripted import ScriptedProximity
from hal.clock import Deadline, WallClock
from hal.conformance import ProximityContract, Rig
from hal.registry import Context

CLOCK = WallClock()


class TestRangefinder(ProximityContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = start(ScriptedProximity(), {})
        device = connect(Context(name="rangefinder"), far_side.address)
        yield Rig(device=device, clock=CLOCK, sample_period_s=2.5 / 50.0, inject=far_side.inject)
        device.close()
        far_side.close()


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "garbage"])
def test_a_damaged_wire_still_brings_samples(fault: str) -> None:
    far_side = start(ScriptedProximity(), {"fault": fault, "every": 3})
    device = connect(Context(name="rangefinder"), far_side.address)
    try:
        samples = [device.newest(Deadline.after(CLOCK, 1.0), not_before_s=CLOCK.now_s()) for _ in range(5)]
        assert all(b.sequence > a.sequence for a, b in pairwise(samples))
    finally:
        device.close()
        far_side.close()
