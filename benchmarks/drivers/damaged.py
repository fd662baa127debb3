"""Counts the damaged frames of a TFmini that pass its checks: a stream in which every third frame is damaged."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from benchmarks.drivers.report import line
from drivers.emulators.faults import FaultOptions, FaultPlan
from drivers.tfmini import data_framer
from drivers.transport.checks import sum_low_byte

COLDEST, HOTTEST = (25 + 256) * 8, (60 + 256) * 8
FRAMES = 300_000


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
