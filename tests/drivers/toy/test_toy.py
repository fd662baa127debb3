"""What a new device costs its author: the toy's driver keeps all promises, and is as short as the scaffold promises."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators.scripted import ScriptedProximity
from drivers.scaffold import new_driver
from hal.conformance import ProximityContract, Rig
from hal.devices import DeviceKind
from hal.errors import CellError, DeviceUnavailable
from hal.readings import Quality
from hal.registry import Context
from tests.drivers.rigs import CLOCK, soon, until
from tests.drivers.toy import rangefinder
from tests.drivers.toy.emulator import start

WRITTEN = Path(rangefinder.__file__)
FAULTS = ("crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo", "status", "disconnect")
BLANK = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


class TestToy(ProximityContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = start(ScriptedProximity(), {})
        device = rangefinder.connect(Context(name="toy"), far_side.address)
        yield Rig(device=device, clock=CLOCK, sample_period_s=0.05, inject=far_side.inject)
        device.close()
        far_side.close()


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_of_the_line_gives_a_wrong_distance(fault: str) -> None:
    options = {"fault": fault, "every": 5, "delay_s": 0.15, "silent_s": 0.15, "away_s": 0.05}
    backing = ScriptedProximity()
    far_side = start(backing, options)
    device = rangefinder.connect(Context(name="toy"), far_side.address)
    good = set[int]()

    def has_enough() -> bool:
        try:
            steps = (device.newest(soon(0.4)).value - backing.first_m) / 0.001
        except CellError as error:
            assert "toy" in str(error)
            return False
        assert abs(steps - round(steps)) < 1e-6 and backing.reads - 60 <= round(steps) <= backing.reads
        good.add(round(steps))
        return len(good) >= 5

    try:
        until(has_enough, within_s=10.0)
    finally:
        device.close()
        far_side.close()


def test_a_weak_echo_is_invalid_and_another_device_is_refused() -> None:
    far_side = start(ScriptedProximity(fixed_m=float("nan")), {})
    device = rangefinder.connect(Context(name="toy"), far_side.address)
    assert device.newest(soon()).quality is Quality.INVALID
    device.close()
    far_side.close()
    far_side = start(ScriptedProximity(), {})
    far_side.reply = lambda peer, data: None  # type: ignore[method-assign]  # a device that does not know `ID?`
    with pytest.raises(DeviceUnavailable, match="RF7"):
        rangefinder.connect(Context(name="toy"), far_side.address)
    far_side.close()


def code_lines(text: str) -> set[int]:
    """Return the numbers of the lines with code: without blank lines, comments and docstrings."""
    documents = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None
        for line in range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)
    }
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {n for token in tokens if token.type not in BLANK for n in range(token.start[0], token.end[0] + 1)}
    return lines - documents


def test_the_driver_is_short_and_most_of_it_is_the_scaffolds() -> None:
    generated = new_driver("toy", DeviceKind.PROXIMITY, package="toy_package")[Path("toy_package/toy.py")]
    text = WRITTEN.read_text(encoding="utf-8")
    given = {line.strip() for line in generated.splitlines()}
    own = [number for number in code_lines(text) if text.splitlines()[number - 1].strip() not in given]
    assert len(code_lines(text)) <= 70, "the scaffold's part grew; 120 is the limit for a whole driver"
    assert len(own) <= 45
