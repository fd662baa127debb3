"""Feeds every parser with broken bytes: `python -m benchmarks.fuzz_parsers --cases 100000 --seed 1`.

A case is a valid message that was cut, repeated, spliced or changed, fed in random chunks. A parser may ignore it or raise one of
its own errors; anything else is a crash, which is printed with the bytes that repeat it. The exit code is 1 after a crash.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivers import bota, ft300, lms200, scip, tfmini
from drivers.dynamixel import protocol
from drivers.kinds import pixel_formats
from drivers.rplidar import express, nodes
from drivers.stream.sources import PartParser
from drivers.transport import can_frames, checks, modbus_pdu, slcan
from drivers.transport.link import WireError
from drivers.ur import rtde
from hal.config import load_cell
from hal.errors import CellError
from hal.panel import load_panel
from service.http.body import parse
from service.http.problems import BadBody
from service.processes.latch import Latch
from service.processes.stop import StopServer
from service.schema.mission_request import MissionRequest

ROOT = Path(__file__).parents[1]
Feed = Callable[[Sequence[bytes]], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Parser:
    """A parser: `feed` makes a new one and gives it the chunks; `samples` are valid messages; `cost` divides the cases."""

    feed: Feed
    samples: tuple[bytes, ...]
    cost: int = 1


def parsers(folder: Path) -> dict[str, Parser]:
    """Return all parsers by name; `folder` takes the files that loaders read."""
    status = protocol.encode(1, protocol.STATUS, b"\x00\x10\x20\x30\x40")
    cell, panel = ROOT / "cells" / "bench.toml", ROOT / "panels" / "bench.toml"
    boundary = b"--b\r\nContent-Type: image/jpeg\r\nContent-Length: 4\r\n\r\nabcd\r\n"
    crc = checks.crc_modbus
    force = b"\x20\x4e" + bytes(12)
    return {
        "dynamixel": Parser(feed=_dynamixel, samples=(status, status * 2)),
        "ft300 stream": Parser(feed=_framed(ft300.stream_framer), samples=(force + crc(force).to_bytes(2, "little"),)),
        "bota": Parser(feed=_framed(bota.framer), samples=(b"\xaa" + bytes(bota.FRAME_BYTES - 1),)),
        "tfmini": Parser(feed=_framed(tfmini.data_framer), samples=(b"\x59\x59\x10\x00\x20\x00\x30\x00\x12",)),
        "lms200": Parser(feed=_lms200, samples=(b"\x02\x80\x06\x00\xb0\x01\x00\x01\x02\x00\x00\x00",)),
        "rplidar nodes": Parser(feed=_fed(nodes.NodeParser), samples=(b"\x3e\x01\x00\x40\x1f" * 30,), cost=4),
        "rplidar capsules": Parser(feed=_fed(express.CapsuleParser), samples=(_capsule(0), _capsule(1) * 3), cost=4),
        "scip": Parser(feed=_scip, samples=(b"MD0000001000000\n00P\n0000A\n\n", b"VV\n00P\nVEND:x;Z\n\n")),
        "slcan": Parser(feed=_fed(slcan.LineReader), samples=(b"t1232aabb\rT12345678101\r", b"d1234\rr1230\r\x07z\r")),
        "can records": Parser(feed=can_frames_of, samples=(_record(0x123, b"ab"), _record(1, b"") * 3)),
        "modbus answers": Parser(feed=_modbus, samples=(b"\x03\x04\x00\x01\x00\x02", b"\x83\x02")),
        "rtde": Parser(feed=_fed(rtde.PackageParser), samples=(rtde.package("V", b"\x01"), rtde.package("U", bytes(20)))),
        "mjpeg parts": Parser(feed=_parts, samples=(boundary, boundary * 3, boundary.replace(b"Length: 4", b"X: 1"))),
        "pixel formats": Parser(feed=_pixels, samples=(bytes(8 * 8 * 3),), cost=4),
        "http body": Parser(feed=_body, samples=(b'{"objects": ["a"], "actions": []}', b'{"wanted": {"sigma_m": 0.1}}'), cost=4),
        "stop port": Parser(feed=partial(_stop, _latch(folder)), samples=(b"POST /v1/stop HTTP/1.1\r\nHost: a\r\n\r\n",)),
        "cell file": Parser(feed=partial(_file, load_cell, folder / "cell.toml"), samples=(cell.read_bytes(),), cost=50),
        "panel file": Parser(feed=partial(_file, load_panel, folder / "panel.toml"), samples=(panel.read_bytes(),), cost=50),
    }  # fmt: skip


def _fed(make: Callable[[], Any]) -> Feed:
    def feed(chunks: Sequence[bytes]) -> object:
        one = make()
        return [one.feed(chunk) for chunk in chunks]

    return feed


def _framed(make: Callable[[], Any]) -> Feed:
    return _fed(make)


def _dynamixel(chunks: Sequence[bytes]) -> object:
    framer = protocol.framer()
    return [protocol.decode(frame) for chunk in chunks for frame in framer.feed(chunk)]


def _lms200(chunks: Sequence[bytes]) -> object:
    framer = lms200.framer()
    return [[lms200.decode_scan(frame[4:-2]) for frame in framer.feed(chunk)] for chunk in chunks] + [
        lms200.decode_scan(chunks[0])
    ]


def _scip(chunks: Sequence[bytes]) -> object:
    one = scip.ScipParser()
    return [scip.parse_parameters(message.lines) for chunk in chunks for message in one.feed(chunk, "")]


def can_frames_of(chunks: Sequence[bytes]) -> object:
    """Read the chunks as records of CAN frames."""
    one = can_frames.FrameReader()
    return [one.feed(chunk, 1.0) for chunk in chunks]


def _record(id_: int, data: bytes) -> bytes:
    return can_frames.record(can_frames.CanFrame(id_, data))


def _modbus(chunks: Sequence[bytes]) -> object:
    """Decode an answer as the master does: only bytes that begin as the question asks, of the length that was asked for."""
    question = modbus_pdu.read_registers(3, 0, 2)
    pdu = b"".join(chunks)
    begins = [head for head, _ in question.forms]
    is_whole = len(pdu) == 2 + 4 if pdu[:1] == begins[0][:1] else len(pdu) == 2
    return modbus_pdu.decode(question, pdu) if any(map(pdu.startswith, begins)) and is_whole else None


def _parts(chunks: Sequence[bytes]) -> object:
    one = PartParser()
    return [list(one.feed(chunk)) for chunk in chunks]


def _pixels(chunks: Sequence[bytes]) -> object:
    data = b"".join(chunks)
    code = sorted(pixel_formats.FORMATS)[len(data) % len(pixel_formats.FORMATS)]
    return pixel_formats.decode(np.frombuffer(data, np.uint8), code, width_px=8, height_px=8, is_colour=bool(data[:1]))


def _body(chunks: Sequence[bytes]) -> object:
    return parse(b"".join(chunks), MissionRequest)


def _latch(folder: Path) -> Latch:
    return Latch.create(folder / "latch")


def _stop(latch: Latch, chunks: Sequence[bytes]) -> object:
    server, head = StopServer(latch), b"".join(chunks)
    return server.answer(head, server.begin(head.partition(b"\n")[0], "127.0.0.1"))


def _file(load: Callable[[Path], object], path: Path, chunks: Sequence[bytes]) -> object:
    path.write_bytes(b"".join(chunks))
    return load(path)


def _capsule(first: int) -> bytes:
    body = bytes([0, 0x80 * first]) + bytes(80)
    check = checks.xor_byte(body)
    return bytes([0xA0 | check & 15, 0x50 | check >> 4]) + body


TYPED = (CellError, WireError, BadBody)


def case_of(draw: random.Random, samples: Sequence[bytes]) -> list[bytes]:
    """Return one case in chunks: a sample with up to five changes, or noise."""
    data = bytearray(draw.choice(samples) if draw.random() < 0.95 else draw.randbytes(draw.randrange(200)))
    for _ in range(draw.randrange(6)):
        at = draw.randrange(len(data) + 1)
        match draw.randrange(6):
            case 0:
                data[at : at + draw.randrange(1, 9)] = draw.randbytes(draw.randrange(5))
            case 1:
                data[at : at + 1] = bytes([draw.choice((0, 0x30, 0x7F, 0x80, 0xB2, 0xFF))])
            case 2:
                del data[at:]
            case 3:
                data[at:at] = data[: draw.randrange(40)]
            case 4:
                data[at:at] = draw.choice(samples)[:100]
            case _:
                if at < len(data):
                    data[at] ^= 1 << draw.randrange(8)
    cut = draw.randrange(len(data) + 1)
    return [bytes(data[:cut]), bytes(data[cut:])]


def fuzz(parser: Parser, *, cases: int, seed: int) -> list[str]:
    """Feed a parser with this many cases; returns a line for each crash, at most ten."""
    draw = random.Random(seed)
    crashes: list[str] = []
    for _ in range(max(1, cases // parser.cost)):
        chunks = case_of(draw, parser.samples)
        try:
            parser.feed(chunks)
        except TYPED:
            pass
        except Exception as error:  # what is looked for
            crashes.append(f"{type(error).__name__}: {error}; chunks {chunks!r}"[:600])
            if len(crashes) == 10:
                break
    return crashes


def main() -> None:
    """Fuzz all parsers and print a table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--cases", type=int, default=100_000, help="cases for each parser; slow ones get fewer")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--only", default="", help="only parsers whose name contains this")
    given = options.parse_args()
    print("| parser | cases | cases a second | crashes |\n| --- | --- | --- | --- |")
    found: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, parser in parsers(Path(folder)).items():
            if given.only not in name:
                continue
            begun_s = time.perf_counter()
            crashes = fuzz(parser, cases=given.cases, seed=given.seed)
            count = max(1, given.cases // parser.cost)
            print(f"| {name} | {count} | {count / (time.perf_counter() - begun_s):.0f} | {len(crashes)} |", flush=True)
            found += [f"{name}: {crash}" for crash in crashes]
    print("\n".join(found))
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
