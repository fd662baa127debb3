"""Rangefinder keeps the promises of its kind, over a whole wire and over a damaged one."""

from collections.abc import Iterator
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
        yield Rig(device=device, clock=CLOCK, sample_period_s=0.05, inject=far_side.inject)
        device.close()
        far_side.close()


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "garbage"])
def test_a_damaged_wire_still_brings_samples(fault: str) -> None:
    far_side = start(ScriptedProximity(), {"fault": fault, "every": 3})
    device = connect(Context(name="rangefinder"), far_side.address)
    try:
        samples = [device.newest(Deadline.after(CLOCK, 1.0), not_before_s=CLOCK.now_s()) for _ in range(5)]
        assert all(b.sequence > a.sequence for a, b in zip(samples, samples[1:], strict=False))
    finally:
        device.close()
        far_side.close()


def test_the_cell_file_finds_it_by_name() -> None:
    """Once the package is installed, `driver = "acme:rangefinder"` is all that a cell file needs."""
    from hal.registry import device_factory, emulator_factory

    assert device_factory("acme:rangefinder") is connect
    assert emulator_factory("acme_rangefinder") is start
