"""No parser crashes on broken bytes, and the fuzzer would tell if one did."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.fuzz_parsers import Parser, fuzz, parsers
from drivers.stream.sources import PartParser
from hal.errors import InvalidRequest

CASES = 400


def test_no_parser_crashes_on_broken_bytes(tmp_path: Path) -> None:
    crashes = {name: fuzz(parser, cases=CASES, seed=7) for name, parser in parsers(tmp_path).items()}
    assert {name: found for name, found in crashes.items() if found} == {}


@pytest.mark.parametrize("length", [b"\xb2", b"4\xb9", b"9" * 5000])
def test_a_length_that_is_no_number_is_not_read_as_one(length: bytes) -> None:
    part = b"--b\r\nContent-Length: " + length + b"\r\n\r\nabcd\r\n--b\r\n\r\n"
    assert [content for _, content in PartParser().feed(part)] == [b"abcd"]


def test_a_crash_is_told_with_its_bytes_and_an_error_of_the_parser_is_none() -> None:
    def feed(chunks: Sequence[bytes]) -> object:
        if 0xFF in b"".join(chunks):
            raise IndexError("planted")
        raise InvalidRequest("no", hint="no")

    found = fuzz(Parser(feed=feed, samples=(b"abc\xff",)), cases=CASES, seed=1)
    assert len(found) == 10
    assert found[0].startswith("IndexError: planted; chunks [")
