"""Feeds random bytes with valid frames and headers among them to every parser, in chunks of random length."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from benchmarks.drivers.report import line
from drivers import bota, ft300, lms200, scip, tfmini
from drivers.dynamixel import protocol
from drivers.rplidar.express import CapsuleParser
from drivers.rplidar.nodes import NodeParser
from drivers.transport.framing import Framer
from drivers.transport.slcan import LineReader
from drivers.ur import rtde

INPUTS = 1_000_000
Feed = Callable[[bytes], Any]


def _accepts(frame: bytes) -> bool:
    return len(frame) > 0


def parsers() -> dict[str, tuple[Feed, bytes]]:
    """Return each parser with the beginning of one of its frames."""
    lying = Framer(b"\xaa", lambda d: d[1] if len(d) > 1 else None, _accepts)
    answers = scip.ScipParser()
    return {
        "tfmini": (tfmini.data_framer().feed, b"\x59\x59"),
        "ft300": (ft300.stream_framer().feed, b"\x20\x4e"),
        "bota": (bota.framer().feed, b"\xaa"),
        "lms200": (lms200.framer().feed, b"\x02\x80\x05\x00"),
        "dynamixel": (protocol.framer().feed, protocol.HEADER),
        "rplidar": (NodeParser().feed, b"\x3e\x01\x02\x03\x04"),
        "rplidar express": (CapsuleParser().feed, b"\xa5\x5a"),
        "scip": (lambda chunk: answers.feed(chunk, "MD"), b"MD0000\n99b\n"),
        "rtde": (rtde.PackageParser().feed, b"\x00\x10U"),
        "slcan": (LineReader().feed, b"t1812"),
        "slcan fd": (LineReader().feed, b"D181"),
        "false length": (lying.feed, b"\xaa"),
    }


def part_fuzz(seconds: float) -> None:  # noqa: ARG001  # a number of inputs, however long they take
    """Feed a million inputs to each parser."""
    for name, (feed, head) in parsers().items():
        chance, crashes = random.Random(name), 0
        noise = chance.randbytes(1 << 16)
        for _ in range(INPUTS):
            at, length = chance.randrange(len(noise) - 40), int(40 * chance.random())
            chunk = noise[at : at + length]
            if length & 1:
                chunk = head + chunk
            try:
                feed(chunk)
            except Exception as error:
                crashes += 1
                print(f"    {name}: {error!r} on {chunk.hex()}")
        line(f"fuzzing {name}: inputs, crashes", "1e6, 0", f"{INPUTS:.0e}, {crashes}", crashes == 0)
