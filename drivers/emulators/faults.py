"""Faults that an emulator injects into every `every`-th frame; a seed makes them reproducible."""

from __future__ import annotations

import random
from enum import StrEnum
from typing import Annotated

from pydantic import Field

from hal.strict import Strict


class WireFault(StrEnum):
    """The ten link faults that the acceptance tests inject."""

    CRC = "crc"  # one bit flipped in the part that the protocol checks
    DROP = "drop"  # some bytes of the frame lost
    DUP = "dup"  # the frame sent twice
    SPLIT = "split"  # a pause between the halves of the frame
    DELAY = "delay"  # the answer comes after the time-out
    SILENT = "silent"  # nothing is sent for `silent_s`
    GARBAGE = "garbage"  # noise and a false header before the frame
    ECHO = "echo"  # the host receives its own bytes first, as on two-wire RS-485
    STATUS = "status"  # the device's own error report in place of the frame
    DISCONNECT = "disconnect"  # half a frame, then the port vanishes and returns as a new one


class FaultOptions(Strict):
    """Fault options of every emulator."""

    fault: WireFault | None = None
    mixed: tuple[WireFault, ...] = ()  # if given, one of these is chosen at random each time, in place of `fault`
    every: Annotated[int, Field(ge=1)] = 3
    delay_s: Annotated[float, Field(gt=0, le=5)] = 0.3
    split_s: Annotated[float, Field(gt=0, le=1)] = 0.03
    silent_s: Annotated[float, Field(gt=0, le=10)] = 0.3
    away_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    seed: int = 0


class FaultPlan:
    """Decides for each frame which fault to inject."""

    def __init__(self, options: FaultOptions) -> None:
        self.options = options
        self.injected = 0
        self.frames = 0
        self._random = random.Random(options.seed)

    def next(self) -> WireFault | None:
        """Return the fault for the next frame, or None."""
        self.frames += 1
        if self.frames % self.options.every or not (self.options.fault or self.options.mixed):
            return None
        self.injected += 1
        return self._random.choice(self.options.mixed) if self.options.mixed else self.options.fault

    def flip_bit(self, frame: bytes, protected: slice) -> bytes:
        """Return the frame with one bit of its protected part flipped; empty (a lost frame) if nothing is protected."""
        places = range(len(frame))[protected]
        if not places:
            return b""
        place = self._random.choice(places)
        return frame[:place] + bytes([frame[place] ^ 1 << self._random.randrange(8)]) + frame[place + 1 :]

    def lose_bytes(self, frame: bytes) -> bytes:
        """Return the frame without one to three of its bytes."""
        kept = bytearray(frame)
        for _ in range(min(self._random.randint(1, 3), len(kept))):
            del kept[self._random.randrange(len(kept))]
        return bytes(kept)

    def noise(self, frame: bytes) -> bytes:
        """Return random bytes that end in a false header, the first third of the frame itself."""
        return self._random.randbytes(self._random.randint(3, 20)) + frame[: max(1, len(frame) // 3)]
