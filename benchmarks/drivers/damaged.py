"""Feeds drivers with damaged streams as fast as they take them.

Of a TFmini's stream every third frame is damaged, and those that pass its checks are counted. Of an RPLIDAR's stream one
burst in twenty is damaged, and the turns that are given nevertheless are counted.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.drivers.report import line
from drivers.emulators.faults import FaultOptions, FaultPlan
from drivers.emulators.rplidar import encode_capsules, encode_turn
from drivers.rplidar.scanner import Rplidar, RplidarOptions
from drivers.tfmini import data_framer
from drivers.transport.checks import sum_low_byte
from drivers.transport.link import now_s
from hal.arrays import Array
from hal.readings import Quality
from hal.registry import Context

COLDEST, HOTTEST = (25 + 256) * 8, (60 + 256) * 8
FRAMES = 300_000
SHARE, DEVICE_S, TURNS_HZ, BURSTS, NODES = 0.05, 90.0, 5.5, 36, 384


def damages(seed: int) -> dict[str, Callable[[bytes], bytes]]:
    """Return the kinds of damage by name, from a seed."""
    plan, chance = FaultPlan(FaultOptions(seed=seed)), random.Random(seed)

    def burst(frame: bytes) -> bytes:
        begin = chance.randrange(len(frame))
        return frame[:begin] + frame[begin + chance.randrange(1, 6) :]

    return {
        "one to three bytes lost": plan.lose_bytes,
        "end lost": lambda frame: frame[: chance.randrange(1, len(frame))],
        "up to five bytes in a row lost": burst,
        "noise and a false header before it": lambda frame: plan.noise(frame) + frame,
        "two bits flipped": lambda frame: plan.flip_bit(plan.flip_bit(frame, slice(None)), slice(None)),
    }


def passed(damage: Callable[[bytes], bytes], frames: int, *, seed: int) -> int:
    """Return how many frames that were never sent pass, of a stream of any distances, strengths and a slow temperature."""
    chance, framer = random.Random(seed), data_framer()
    raw, sent, wrong = (38 + 256) * 8, set[bytes](), 0
    for number in range(frames):
        raw = min(max(raw + (number % 20 == 0) * chance.choice((-1, 0, 1)), COLDEST), HOTTEST)
        body = b"\x59\x59" + struct.pack("<HHH", chance.randrange(50, 12_000), chance.randrange(100, 30_000), raw)
        frame = body + bytes([sum_low_byte(body)])
        sent.add(frame)
        wrong += sum(got not in sent for got in framer.feed(damage(frame) if number % 3 == 2 else frame))
    return wrong


def part_damaged(seconds: float) -> None:  # noqa: ARG001  # a number of frames, however long they take
    """Count what passes of a hundred thousand damaged frames of each kind; a flip of two bits can leave the sum right."""
    for name, damage in damages(7).items():
        wrong, limit = passed(damage, FRAMES, seed=7), FRAMES // 3 if "flipped" in name else 10
        told = "-" if "flipped" in name else "10"
        line(f"TFmini, {name}: damaged frames that pass, of {FRAMES // 3}", told, str(wrong), wrong <= limit)
    for mode in ("standard", "express"):
        for name, damage in burst_damages(7).items():
            found = turns_given(mode, damage, DEVICE_S, seed=7)
            told = f"{found.given} of {found.turns} turns ({found.valid} whole), {found.wrong} of {found.beams} beams wrong"
            line(f"RPLIDAR {mode}, {name} in 5 % of bursts, 90 s", "90 %", told, found.given >= 0.9 * found.turns)


def burst_damages(seed: int) -> dict[str, Callable[[bytes], bytes]]:
    """Return the kinds of damage to a burst by name, from a seed."""
    plan = FaultPlan(FaultOptions(seed=seed))
    return {
        "one to three bytes lost": plan.lose_bytes,
        "one bit flipped": lambda burst: plan.flip_bit(burst, slice(None)),
        "burst lost": lambda _: b"",
        "noise and a false header before it": lambda burst: plan.noise(burst) + burst,
    }


@dataclass(slots=True, kw_only=True)
class TurnsGiven:
    """What came of a damaged stream: turns sent, given, and given without a gap; beams given, and wrong ones."""

    turns: int
    given: int = 0
    valid: int = 0
    beams: int = 0
    wrong: int = 0


def turns_given(mode: str, damage: Callable[[bytes], bytes], seconds: float, *, seed: int) -> TurnsGiven:
    """Feed an RPLIDAR driver with a stream of `seconds` device time in which one burst in twenty is damaged."""
    options = RplidarOptions.model_validate(
        {"port": "/dev/null", "mode": mode, "scan_rate_hz": TURNS_HZ, "beams": NODES}
    )
    device, chance, seen, at_s = Rplidar(Context(name="dut"), options), random.Random(seed), 0, now_s()
    found, angle_rad = TurnsGiven(turns=round(seconds * TURNS_HZ)), np.arange(NODES) * 2.0 * np.pi / NODES
    for turn in range(found.turns):
        is_express = mode == "express"
        range_m = true_range_m(turn)
        data = encode_capsules(range_m, is_first=turn == 0) if is_express else encode_turn(angle_rad, range_m)
        unit = 84 if is_express else 5
        size = max(1, len(data) // unit // BURSTS) * unit
        for begin in range(0, len(data), size):
            burst = data[begin : begin + size]
            at_s += len(burst) / len(data) / TURNS_HZ
            if sent := damage(burst) if chance.random() < SHARE else burst:
                device.receive(sent, at_s)
        for sample in device.mailbox.since(seen)[0]:
            seen, depth_m = sample.sequence, sample.value.depth_m[0]
            known = np.isfinite(depth_m)
            off = [np.sum(np.abs(depth_m - true_range_m(one))[known] > 0.0006) for one in range(turn - 3, turn + 1)]
            found.given += 1
            found.valid += sample.quality is Quality.VALID
            found.beams += int(known.sum())
            found.wrong += int(min(off))
    device.close()
    return found


def true_range_m(turn: int) -> Array:
    """Return the distances of a turn, which show its number."""
    wave = np.round(1.0 + 0.5 * np.sin(0.05 * np.arange(NODES)), 3)
    return np.asarray(wave + 0.001 * (turn % 100))
