"""Contract of every device, whatever its kind."""

from __future__ import annotations

import inspect
import statistics
from collections.abc import Iterator
from typing import Any, Generic, TypeVar

import pytest

from hal.conformance.rig import SILENT_READS, SLACK_S, Level, Rig
from hal.devices import PROTOCOLS, Device, DeviceKind
from hal.errors import DeviceTimeout, DeviceUnavailable
from hal.readings import Quality, Stamped
from hal.simulated import Fault

D = TypeVar("D", bound=Device)
level = pytest.mark.conformance


class DeviceContract(Generic[D]):
    """Tests that apply to all kinds; a kind's contract defines how to read its newest sample."""

    kind: DeviceKind

    @pytest.fixture
    def rig(self) -> Iterator[Rig[D]]:
        """Yield the connected device under test; every subclass supplies its own."""
        raise NotImplementedError("a conformance class needs a `rig` fixture")

    def read(self, rig: Rig[D], duration_s: float = 2.0) -> Stamped[Any]:
        """Read the kind's main quantity once."""
        raise NotImplementedError

    def check_value(self, rig: Rig[D], value: Any) -> None:
        """Check that a value has the right type, shape and range."""
        raise NotImplementedError

    @level(Level.STATIC)
    def test_it_says_its_name_and_kind(self, rig: Rig[D]) -> None:
        assert rig.device.name
        assert rig.device.kind is self.kind

    @level(Level.STATIC)
    def test_it_has_every_method_of_its_kind(self, rig: Rig[D]) -> None:
        assert isinstance(rig.device, PROTOCOLS[self.kind])

    @level(Level.STATIC)
    def test_every_call_to_the_device_takes_a_deadline(self, rig: Rig[D]) -> None:
        for name in _device_calls(self.kind):
            parameters = inspect.signature(getattr(type(rig.device), name)).parameters
            assert "deadline" in parameters, f"{name} has no deadline"
            assert parameters["deadline"].default is inspect.Parameter.empty, f"{name} has a default deadline"

    @level(Level.CONNECT)
    def test_health_says_connected_after_a_sample(self, rig: Rig[D]) -> None:
        self.read(rig)
        health = rig.device.health()
        assert health.connected
        assert health.samples >= 1

    @level(Level.CONNECT)
    def test_close_twice_is_once(self, rig: Rig[D]) -> None:
        rig.device.close()
        rig.device.close()
        assert not rig.device.health().connected

    @level(Level.CONNECT)
    def test_after_close_every_read_says_unavailable(self, rig: Rig[D]) -> None:
        rig.device.close()
        with pytest.raises(DeviceUnavailable) as caught:
            self.read(rig)
        assert rig.device.name in str(caught.value)

    @level(Level.READ)
    def test_a_sample_is_whole_and_stamped_in_the_past(self, rig: Rig[D]) -> None:
        sample = self.read(rig)
        assert sample.host_time_s <= rig.clock.now_s()
        if sample.quality is not Quality.INVALID:
            self.check_value(rig, sample.value)

    @level(Level.READ)
    def test_later_samples_have_later_stamps_and_numbers(self, rig: Rig[D]) -> None:
        first = self.read(rig)
        rig.pass_time()
        second = self.read(rig)
        assert second.sequence > first.sequence
        assert second.host_time_s > first.host_time_s

    @level(Level.READ)
    def test_a_disconnected_device_says_so_and_comes_back(self, rig: Rig[D]) -> None:
        self.read(rig)
        rig.begin(Fault.DISCONNECTED)
        rig.pass_time()
        with pytest.raises((DeviceUnavailable, DeviceTimeout)) as caught:
            self.read(rig, 0.2)
        assert rig.device.name in str(caught.value)
        rig.end_faults()
        self.read_until_it_works(rig)

    @level(Level.READ)
    def test_silence_is_a_timeout_and_in_time(self, rig: Rig[D]) -> None:
        self.read(rig)
        rig.begin(Fault.SILENT)
        rig.pass_time()
        over_s = []
        for _ in range(SILENT_READS):
            started_s = rig.clock.now_s()
            with pytest.raises(DeviceTimeout):
                self.read(rig, 0.1)
            over_s.append(rig.clock.now_s() - started_s - 0.1)
        assert statistics.median(over_s) <= SLACK_S
        rig.end_faults()
        self.read_until_it_works(rig)

    def read_until_it_works(self, rig: Rig[D]) -> None:
        """Repeat reading until it succeeds, for at most 5 s on the rig's clock."""
        give_up = rig.deadline(5.0)
        while True:
            try:
                self.read(rig, 0.5)
                return
            except (DeviceTimeout, DeviceUnavailable):
                if give_up.is_past():
                    raise
                rig.pass_time()


def _device_calls(kind: DeviceKind) -> tuple[str, ...]:
    """Return the names of the methods of a kind's interface that communicate with the device."""
    own = vars(PROTOCOLS[kind])
    return tuple(n for n in own if n.startswith(("read_", "command", "set_", "enable", "stop")) and callable(own[n]))
