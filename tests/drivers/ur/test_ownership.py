"""A controller's arm has one owner; a second one is refused, and the refusal names the first."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from drivers.emulators import ur as emulator
from drivers.emulators.scripted import ScriptedArm
from drivers.transport.host_claim import HostClaim, TakenBy
from drivers.ur import ownership
from hal.errors import DeviceUnavailable
from hal.registry import Context, connect
from tests.drivers.rigs import soon, until, wired

DRIVER = "ur:rtde"
HOLDER = """
import sys
from drivers.transport.host_claim import HostClaim
claim = HostClaim("arm of cell first")
claim.take(sys.argv[1])
print("taken", flush=True)
sys.stdin.read()
"""


def test_a_second_service_is_refused_with_the_name_of_the_first_and_takes_over_when_that_has_ended() -> None:
    arm = ScriptedArm()
    far_side = emulator.start(arm, {})
    resource = f"127.0.0.1:{far_side.address['port']}/the arm"
    first = subprocess.Popen(
        [sys.executable, "-c", HOLDER, resource], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert first.stdout is not None and first.stdout.readline() == "taken\n"
        with pytest.raises(DeviceUnavailable, match=f"is taken by process {first.pid}, arm of cell first"):
            connect(Context(name="second"), DRIVER, dict(far_side.address))
        first.kill()  # nothing is left to clean up
        first.wait(5.0)
        with wired(far_side, DRIVER) as device:
            device.enable(deadline=soon())
            device.command_position(arm.position_rad, deadline=soon())
    finally:
        first.kill()
        first.communicate()
        far_side.close()


def test_a_second_machine_is_refused_by_the_controller_and_reads_who_has_the_arm(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with wired(far_side := emulator.start(ScriptedArm(), {}), DRIVER) as first:
        until(lambda: first._is_marked and far_side._registers[32] == os.getpid())
        monkeypatch.setattr(HostClaim, "take", lambda self, resource: None)  # another machine does not see our claim
        with pytest.raises(DeviceUnavailable, match=f"is taken by process {os.getpid()} on 127.0.0.1"):
            connect(Context(name="second"), DRIVER, dict(far_side.address))
        first.read_state(deadline=soon())


def test_an_owner_without_marks_is_an_unknown_client() -> None:
    assert ownership.named(0, 7) == ownership.UNKNOWN
    assert ownership.owner_by_marks("127.0.0.1", 1, answer_s=0.1, device="arm") == ownership.UNKNOWN


def test_after_the_first_has_closed_the_second_connects() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    try:
        first = connect(Context(name="first"), DRIVER, dict(far_side.address))
        first.close()
        second = connect(Context(name="second"), DRIVER, dict(far_side.address))
        second.close()
    finally:
        far_side.close()


def test_a_claim_is_held_once_and_released() -> None:
    one, other = HostClaim("one"), HostClaim("other")
    one.take("test claim")
    one.take("test claim")
    with pytest.raises(TakenBy, match=f"process {os.getpid()}, one"):
        other.take("test claim")
    one.release()
    one.release()
    other.take("test claim")
    other.release()
