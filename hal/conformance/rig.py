"""What a backend brings to the conformance kit."""

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
READ_S = 2.0  # generous: a busy machine is not a broken device
SLACK_S = 0.05  # how far past its deadline a call may return
SILENT_READS = 5  # of which the median is judged: a machine that stalls once is no device that is late


class Level(StrEnum):
    """How far a test goes: each level needs the one before."""

    STATIC = "static"
    CONNECT = "connect"
    READ = "read"
    MOTION = "motion"


LEVELS = tuple(Level)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig(Generic[D]):
    """A connected device and the means to try it.

    Attributes:
        clock: the device's clock; `sleep` lets new samples arrive.
        sample_period_s: after this long a new sample must be there.
        inject: begins a fault on the far side (None ends it); None when the backend has no way to do so.
        may_move: the arm, the gripper or the lights may be worked.
    """

    device: D
    clock: Clock
    sample_period_s: float = 0.1
    inject: Callable[[Fault | None], None] | None = None
    may_move: bool = True

    def deadline(self, duration_s: float = READ_S) -> Deadline:
        """A deadline on the rig's clock."""
        return Deadline.after(self.clock, duration_s)

    def pass_time(self) -> None:
        """Let a new sample arrive."""
        self.clock.sleep(2.0 * self.sample_period_s)

    def begin(self, fault: Fault) -> None:
        """Inject a fault, or skip the test where the backend cannot."""
        if self.inject is None:
            pytest.skip(f"this rig has no way to make a device {fault}")
        self.inject(fault)

    def end_faults(self) -> None:
        """Back to normal."""
        if self.inject is not None:
            self.inject(None)

    def need_motion(self) -> None:
        """Skip the test where nothing may move."""
        if not self.may_move:
            pytest.skip("this rig may not move anything (level motion was not asked for)")
