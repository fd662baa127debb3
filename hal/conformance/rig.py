"""Test rig that a backend supplies to the conformance tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, TypeVar

import pytest

from hal.clock import Clock, Deadline
from hal.devices import Device
from hal.simulated import Fault

D = TypeVar("D", bound=Device)
READ_S = 2.0  # long, so that a busy machine is not taken for a broken device
SLACK_S = 0.05  # how far past its deadline a call may return
SILENT_READS = 5  # their median is judged, so that one stall of the machine is not taken for a late device


class Level(StrEnum):
    """What a test requires of the device; each level includes the previous ones."""

    STATIC = "static"
    CONNECT = "connect"
    READ = "read"
    MOTION = "motion"


LEVELS = tuple(Level)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig(Generic[D]):
    """Connected device and what the tests need to exercise it.

    Attributes:
        clock: the device's clock; its `sleep` lets new samples arrive.
        sample_period_s: a new sample must arrive within this time.
        inject: begins a fault in the device or its link, and ends it if called with None; None if the backend has no
            faults.
        may_move: whether the tests may move the arm or the gripper, or switch the lights.
    """

    device: D
    clock: Clock
    sample_period_s: float = 0.1
    inject: Callable[[Fault | None], None] | None = None
    may_move: bool = True

    def deadline(self, duration_s: float = READ_S) -> Deadline:
        """Return a deadline on the rig's clock."""
        return Deadline.after(self.clock, duration_s)

    def pass_time(self) -> None:
        """Wait until a new sample has arrived."""
        self.clock.sleep(2.0 * self.sample_period_s)

    def begin(self, fault: Fault) -> None:
        """Inject a fault, or skip the test if the backend cannot."""
        if self.inject is None:
            pytest.skip(f"this rig cannot make a device {fault}")
        self.inject(fault)

    def end_faults(self) -> None:
        """End the injected fault."""
        if self.inject is not None:
            self.inject(None)

    def need_motion(self) -> None:
        """Skip the test if nothing may move."""
        if not self.may_move:
            pytest.skip("this rig may not move anything (level motion was not asked for)")
