"""No driver gives data that were held up on their way as fresh: each sample is identified by its value.

The chunks are fed with chosen arrival times, so no test waits and none depends on the machine.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers.emulators import rplidar, scip
from drivers.lms200 import Lms200, Lms200Options, telegram
from drivers.rplidar.scanner import Rplidar, RplidarOptions
from drivers.scaffold import new_driver
from drivers.scip import Scip, ScipOptions
from drivers.transport.checks import sum_low_byte, sum_scip
from drivers.transport.link import now_s
from drivers.transport.options import SerialOptions
from hal.devices import DeviceKind
from hal.registry import Context

HELD_S = 0.41
TOLERANCE_S = 0.03  # the longest time between two chunks below


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Talker:
    """A device that streams: its driver, and per sample the chunks in which it leaves, one each `chunk_s`.

    `number` tells the sample from its value.
    """

    device: Any
    chunks: Callable[[int, float], list[bytes]]
    chunk_s: float
    number: Callable[[Any], int]


def lms200() -> Talker:
    def chunks(k: int, taken_s: float) -> list[bytes]:
        body = b"\xb0" + (181 | 1 << 14).to_bytes(2, "little") + 181 * (1000 + k).to_bytes(2, "little") + b"\x10"
        return [telegram(body, address=0x80)]

    device = Lms200(Context(name="scanner"), Lms200Options(port="none"))
    return Talker(device=device, chunks=chunks, chunk_s=0.0266, number=lambda v: round(1000 * v.depth_m[0, 0]) - 1000)


def rplidar_of(mode: str) -> Talker:
    """Return a scanner whose turns of 0.18 s leave in pieces of 15 ms."""

    def chunks(k: int, taken_s: float) -> list[bytes]:
        range_m = np.full(360 if mode == "standard" else 384, 1.0 + 0.01 * k)
        angle_rad = np.arange(360) * math.tau / 360
        if mode == "standard":
            data, size = rplidar.encode_turn(angle_rad, range_m), 30 * 5
        else:
            data, size = rplidar.encode_capsules(range_m, is_first=False), 84
        return [data[at : at + size] for at in range(0, len(data), size)]

    def number(value: Any) -> int:
        seen = value.depth_m[np.isfinite(value.depth_m)]
        assert np.ptp(seen) < 0.001, "two turns were mixed"
        return round((float(np.median(seen)) - 1.0) / 0.01)

    options = RplidarOptions(port="none", mode=mode, scan_rate_hz=5.5)
    return Talker(device=Rplidar(Context(name="scanner"), options), chunks=chunks, chunk_s=0.015, number=number)


def new_one() -> Talker:
    """Return a driver as the scaffold makes it."""
    text = next(text for path, text in new_driver("acme", DeviceKind.PROXIMITY).items() if path.parts[0] == "drivers")
    names: dict[str, Any] = {"__name__": "acme"}
    exec(compile(text, "acme.py", "exec", dont_inherit=True), names)  # noqa: S102  # our own template

    def chunks(k: int, taken_s: float) -> list[bytes]:
        body = struct.pack("<2sBi", b"\xa5\x5a", k % 256, k)
        return [body + bytes([sum_low_byte(body)])]

    class Options(SerialOptions):
        port: str = "none"

    device = names["Acme"](Context(name="finger"), Options())
    return Talker(device=device, chunks=chunks, chunk_s=0.02, number=lambda v: round(1000 * v))


def hokuyo() -> Talker:
    device = Scip(Context(name="scanner"), ScipOptions(host="none"))
    device.beams = device._geometry(
        dict(AMIN="0", AMAX="9", AFRT="5", ARES="1024", DMIN="20", DMAX="4095", SCAN="2400")
    )
    device._request = "MD"

    def chunks(k: int, taken_s: float) -> list[bytes]:
        lines = (
            b"99",
            scip.encode_number(round(1000 * taken_s) % (1 << 24), 4),
            scip.encode_ranges(np.full(10, 1000 + k)),
        )
        return [b"\n".join([b"MD", *(line + bytes([sum_scip(line)]) for line in lines)]) + b"\n\n"]

    return Talker(device=device, chunks=chunks, chunk_s=0.025, number=lambda v: round(1000 * v.depth_m[0, 0]) - 1000)


TALKERS = {
    "lms200": lms200,
    "rplidar standard": lambda: rplidar_of("standard"),
    "rplidar express": lambda: rplidar_of("express"),
    "scaffold": new_one,
    "scip": hokuyo,
}


@pytest.mark.parametrize("where", [0, 3, 7])
@pytest.mark.parametrize("is_sender_asleep", [False, True])
@pytest.mark.parametrize("name", TALKERS)
def test_held_up_data_are_not_given_as_fresh(name: str, is_sender_asleep: bool, where: int) -> None:
    """One chunk in about a second is held up: either those behind it wait too, or the sender sleeps meanwhile."""
    talker, begin_s = TALKERS[name](), now_s()
    taken_s, ended_s, free_s = begin_s, dict[int, float](), -math.inf
    per_sample = len(talker.chunks(0, 0.0))
    for place in range(220):
        taken_s += talker.chunk_s
        k = place // per_sample
        piece = talker.chunks(k, taken_s)[place % per_sample]
        ended_s[k] = taken_s
        if place % 60 == 40 + where:
            free_s = taken_s + HELD_S
        arrived_s = max(taken_s, free_s)
        talker.device.receive(piece, arrived_s)
        if is_sender_asleep:
            taken_s = arrived_s
    samples, _ = talker.device.mailbox.since(0)
    late_s = [sample.host_time_s - ended_s[talker.number(sample.value)] for sample in samples]
    assert max(late_s) < TOLERANCE_S, "older than it claims"
    assert min(late_s) > -0.2, "younger than it claims"
    assert samples[-1].host_time_s > taken_s - 0.5, "samples come again"
