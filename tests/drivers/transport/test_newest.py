"""A device never returns a sample older than it promises, however long its reader has waited."""

from __future__ import annotations

import threading

import pytest

from drivers.transport.device import WireDevice
from drivers.transport.link import now_s
from hal.clock import Deadline, SimClock
from hal.devices import DeviceKind
from hal.errors import DeviceTimeout
from hal.readings import Stamped
from hal.registry import Context
from tests.drivers.rigs import until

MAX_AGE_S = 0.05


class Bare(WireDevice[str]):
    """Device without a link; the test publishes its samples."""

    kind = DeviceKind.PROXIMITY

    def release(self) -> None: ...

    def is_up(self) -> bool:
        return True

    def reconnects(self) -> int:
        return 0

    def link_name(self) -> str:
        return "nothing"


def test_a_sample_that_was_held_up_on_the_wire_is_not_given_out_when_it_has_grown_too_old() -> None:
    clock = SimClock(start_s=10.0)
    device, got = Bare(Context(name="late", clock=clock), max_age_s=MAX_AGE_S), list[Stamped[str]]()
    reader = threading.Thread(target=lambda: got.append(device.newest(Deadline.after(clock, 30.0))), daemon=True)
    reader.start()
    until(lambda: len(device.mailbox._bells) > 0)  # the reader waits for a sample that is valid at 9.95 s or later
    clock.set_now_s(10.2)
    device.publish("held up", valid_s=now_s() - 0.22)  # was valid at 9.98 s and arrives at 10.2 s
    until(lambda: got != [] or len(device.mailbox._bells) > 0)
    device.publish("fresh", valid_s=now_s())
    reader.join(30.0)
    assert [sample.value for sample in got] == ["fresh"]


def test_a_sample_that_is_too_old_from_the_beginning_is_a_timeout() -> None:
    clock = SimClock(start_s=10.0)
    device = Bare(Context(name="late", clock=clock), max_age_s=MAX_AGE_S)
    device.publish("old", valid_s=now_s() - 2.0 * MAX_AGE_S)
    with pytest.raises(DeviceTimeout, match="late silent"):
        device.newest(Deadline.after(clock, 0.0))
