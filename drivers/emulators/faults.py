"""What can go wrong on a wire, on purpose: each `every`-th frame, seeded."""

from __future__ import annotations

import random
from enum import StrEnum
from typing import Annotated

from pydantic import Field

from hal.strict import Strict


class WireFault(StrEnum):
    """The ten faults of the acceptance."""

    CRC = "crc"  # a protected bit flipped
    DROP = "drop"  # bytes lost from the frame
    DUP = "dup"  # the frame twice
    SPLIT = "split"  # its halves apart
    DELAY = "delay"  # the answer after the time-out
    SILENT = "silent"  # nothing for a while
    GARBAGE = "garbage"  # noise and a false header before the frame
    ECHO = "echo"  # own bytes come back first, as on two-wire RS-485
    STATUS = "status"  # the device's own error report
    DISCONNECT = "disconnect"  # half a frame, then the port vanishes and returns as another


class FaultOptions(Strict):
    """Options that every emulator takes."""

    fault: WireFault | None = None
    mixed: tuple[WireFault, ...] = ()  # one of these each time, in place of `fault`
    every: Annotated[int, Field(ge=1)] = 3
    delay_s: Annotated[float, Field(gt=0, le=5)] = 0.3
    split_s: Annotated[float, Field(gt=0, le=1)] = 0.03
    silent_s: Annotated[float, Field(gt=0, le=10)] = 0.3
    away_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    seed: int = 0


class FaultPlan:
    """Decides frame by frame."""

    def __init__(self, options: FaultOptions) -> None:
        self.options = options
        self.injected = 0
        self.frames = 0
        self._random = random.Random(options.seed)

    def next(self) -> WireFault | None:
        """The fault of the next frame, or None."""
        self.frames += 1
        if self.frames % self.options.every or not (self.options.fault or self.options.mixed):
            return None
        self.injected += 1
        return self._random.choice(self.options.mixed) if self.options.mixed else self.options.fault

    def flip_bit(self, frame: bytes, protected: slice) -> bytes:
        """One bit of the part that a check sum or header rule protects, flipped; a frame without any is lost."""
        places = range(len(frame))[protected]
        if not places:
            return b""
        place = self._random.choice(places)
        return frame[:place] + bytes([frame[place] ^ 1 << self._random.randrange(8)]) + frame[place + 1 :]

    def lose_bytes(self, frame: bytes) -> bytes:
        """The frame without one to three of its bytes."""
        kept = bytearray(frame)
        for _ in range(min(self._random.randint(1, 3), len(kept))):
            del kept[self._random.randrange(len(kept))]
        return bytes(kept)

    def noise(self, frame: bytes) -> bytes:
        """Random bytes that end in a false header: the first bytes of the frame itself."""
        return self._random.randbytes(self._random.randint(3, 20)) + frame[: max(1, len(frame) // 3)]
