"""Tests of lights and touch pads on the digital points of a UR controller: conformance, faults, refusals."""

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.emulators import ur_io as emulator
from drivers.emulators.scripted import ScriptedLights, ScriptedProximity, ScriptedTouch
from hal.conformance import LightsContract, Rig, TouchContract
from hal.errors import ConfigError, InvalidRequest, Unsupported
from hal.registry import Context, connect
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig


class TestLights(LightsContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedLights(), {}), "ur:lights", sample_period_s=0.05) as rig:
            yield rig


class TestTouch(TouchContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedTouch(), {}), "ur:touch", sample_period_s=0.05) as rig:
            yield rig


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "garbage", "status"])
def test_no_fault_of_the_wire_gives_wrong_lights(fault: str) -> None:
    lights = ScriptedLights()
    with wired(emulator.start(lights, {"fault": fault, "every": 5}), "ur:lights", {"feedback": (0, 1, 2, 3)}) as device:
        device.set_on((True, False, True, True), deadline=soon())
        until(lambda: lights.on == (True, False, True, True))
        assert count_good(device, lambda value: value == lights.on) >= 5


def test_lights_return_to_what_was_commanded_after_unplugging_and_go_out_at_the_end() -> None:
    lights = ScriptedLights()
    far_side = emulator.start(lights, {})
    with wired(far_side, "ur:lights") as device:
        device.set_on((True, True, False, False), deadline=soon())
        until(lambda: lights.on == (True, True, False, False))
        lights.on = (False,) * 4
        far_side.unplug(away_s=0.05)
        until(lambda: lights.on == (True, True, False, False))
        device.close()
        until(lambda: lights.on == (False,) * 4)


def test_other_outputs_are_left_alone() -> None:
    far_side = emulator.start(ScriptedLights(), {})
    far_side.outputs = 0b1100_0000
    with wired(far_side, "ur:lights") as device:
        device.set_on((True,) * 4, deadline=soon())
        until(lambda: far_side.outputs == 0b1100_1111)


def test_the_pads_are_the_tools_inputs() -> None:
    touch = ScriptedTouch()
    with wired(emulator.start(touch, {}), "ur:touch") as device:
        touch.contacts = (False, True)
        until(lambda: device.read_contacts(deadline=soon()).value == (False, True))


def test_wrong_numbers_of_lights_or_points_are_refused() -> None:
    with wired(emulator.start(ScriptedLights(), {}), "ur:lights") as device, pytest.raises(InvalidRequest, match="4"):
        device.set_on((True,), deadline=soon())
    with pytest.raises(ConfigError, match="same number"):
        connect(Context(name="pads"), "ur:touch", {"host": "127.0.0.1", "contacts": (1, 2, 3)})
    with pytest.raises(Unsupported, match="proximity"):
        emulator.start(ScriptedProximity(), {})
