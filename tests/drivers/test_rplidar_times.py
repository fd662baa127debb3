"""The stamps of an RPLIDAR, which has no clock, do not depend on how late the host reads."""

import math

import numpy as np
import pytest

from drivers.emulators import rplidar as emulator
from drivers.rplidar.scanner import Rplidar, RplidarOptions
from drivers.transport.link import now_s
from hal.registry import Context


@pytest.mark.parametrize("mode", ["standard", "express"])
@pytest.mark.parametrize("bursts", [1, 12])
def test_a_burst_that_the_host_reads_late_does_not_make_its_turn_younger(mode: str, bursts: int) -> None:
    """Every seventh burst is read 8 ms late; the number of measurements shows when it came."""
    device = Rplidar(Context(name="scanner"), RplidarOptions.model_validate({"port": "/dev/null", "mode": mode}))
    begin_s, seen, ends_s = now_s(), 0, list[float]()
    range_m = np.linspace(1.0, 2.0, 384)
    turn = emulator.encode_turn(np.arange(384) * math.tau / 384, range_m)
    for n in range(24 * bursts):
        data = turn if mode == "standard" else emulator.encode_capsules(range_m, is_first=n < bursts)
        size = len(data) // bursts
        begin = n % bursts * size
        device.receive(data[begin : begin + size], begin_s + 0.1 * (n + 1) / bursts + (0.008 if n % 7 == 6 else 0.0))
        samples = device.mailbox.since(seen)[0]
        seen = samples[-1].sequence if samples else seen
        ends_s += [sample.host_time_s - begin_s for sample in samples]
    device.close()
    late_s = np.array(ends_s) - np.round(np.array(ends_s), 1)
    assert len(late_s) >= 20
    assert np.abs(late_s[-10:]).max() < 1e-3
