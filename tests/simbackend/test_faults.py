"""Tests of the five faults, begun by a call or by the cell file."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hal.errors import ConfigError, DeviceTimeout, DeviceUnavailable
from hal.readings import Quality, Stamped
from hal.simulated import Fault, FaultInjection
from simbackend.wire import REQUEST, Op
from tests.service.waiting import eventually
from tests.simbackend.rig import SimCell

READS: dict[str, Callable[[Any, Any], Stamped[Any]]] = {
    "arm": lambda device, deadline: device.read_state(deadline=deadline),
    "gripper": lambda device, deadline: device.read_state(deadline=deadline),
    "wrist_camera": lambda device, deadline: device.read_image(deadline=deadline),
    "range_scanner": lambda device, deadline: device.read_range(deadline=deadline),
    "proximity_left": lambda device, deadline: device.read_distance_m(deadline=deadline),
    "finger_touch": lambda device, deadline: device.read_contacts(deadline=deadline),
    "wrist_ft": lambda device, deadline: device.read_wrench(deadline=deadline),
    "panel_lights": lambda device, deadline: device.read_on(deadline=deadline),
}
NAMES = sorted(READS)


def read(bench: SimCell, name: str, device: Any) -> Stamped[Any]:
    return READS[name](device, bench.deadline(0.5))


def content(value: Any) -> Any:
    """Return something comparable from any device's value."""
    for key in ("pixels", "depth_m", "force_n", "position_rad"):
        if hasattr(value, key):
            return np.asarray(getattr(value, key)).tobytes()
    return repr(value)


@pytest.mark.parametrize("name", NAMES)
def test_a_silent_device_times_out_at_once_and_moves_no_time(bench: SimCell, name: str) -> None:
    device = bench.connect(name)
    device.inject_fault(Fault.SILENT)
    before_s = bench.clock.now_s()
    with pytest.raises(DeviceTimeout) as caught:
        read(bench, name, device)
    assert caught.value.details["device"] == name
    assert caught.value.details["waited_s"] == pytest.approx(0.5)
    assert bench.clock.now_s() == before_s
    device.inject_fault(None)
    assert read(bench, name, device).host_time_s == before_s or name.startswith("proximity")


@pytest.mark.parametrize("name", NAMES)
def test_a_stale_device_gives_its_old_stamp(bench: SimCell, name: str) -> None:
    device = bench.connect(name)
    old = read(bench, name, device)
    device.inject_fault(Fault.STALE)
    bench.clock.sleep(0.1)
    stale = read(bench, name, device)
    assert (stale.host_time_s, stale.sequence) == (old.host_time_s, old.sequence)
    assert stale.age_s(bench.clock.now_s()) >= 0.1 - 1e-9


@pytest.mark.parametrize("name", ["wrist_camera", "range_scanner", "wrist_ft"])
def test_a_frozen_device_gives_fresh_stamps_on_old_content(bench: SimCell, name: str) -> None:
    device = bench.connect(name)
    device.inject_fault(Fault.FROZEN)
    first = read(bench, name, device)
    bench.clock.sleep(0.02)
    second = read(bench, name, device)
    assert second.sequence > first.sequence
    assert second.host_time_s > first.host_time_s
    assert content(second.value) == content(first.value)
    device.inject_fault(None)
    assert content(read(bench, name, device).value) != content(first.value)


@pytest.mark.parametrize("name", NAMES)
def test_a_disconnected_device_is_unavailable_and_its_health_says_so(bench: SimCell, name: str) -> None:
    device = bench.connect(name)
    device.inject_fault(Fault.DISCONNECTED)
    with pytest.raises(DeviceUnavailable):
        read(bench, name, device)
    health = device.health()
    assert (health.connected, health.quality, health.errors) == (False, Quality.INVALID, 1)


def test_a_biased_device_is_off_by_the_magnitude(bench: SimCell) -> None:
    force = bench.connect("wrist_ft")
    true = force.read_wrench(deadline=bench.deadline()).value.force_n
    force.inject_fault(Fault.BIASED, magnitude=5.0)
    np.testing.assert_allclose(force.read_wrench(deadline=bench.deadline()).value.force_n - true, 5.0, atol=0.021)
    near = bench.connect("proximity_left")
    true_m = near.read_distance_m(deadline=bench.deadline()).value
    near.inject_fault(Fault.BIASED, magnitude=0.03)
    assert near.read_distance_m(deadline=bench.deadline()).value == pytest.approx(true_m + 0.03, abs=1.1e-4)


def test_a_fault_of_the_cell_file_begins_when_it_says(bench: SimCell) -> None:
    begin_s = bench.clock.now_s() + 0.05
    device = bench.connect("wrist_ft", fault={"kind": "silent", "at_s": begin_s})
    while bench.clock.now_s() < begin_s - 0.003:
        assert math.isfinite(device.read_wrench(deadline=bench.deadline()).value.force_n[0])
        bench.clock.sleep(0.002)
    bench.clock.sleep(0.01)  # one long sleep that includes the begin of the fault must not miss it
    with pytest.raises(DeviceTimeout):
        device.read_wrench(deadline=bench.deadline())


def test_a_frozen_moment_inside_a_long_sleep_is_that_moment(bench: SimCell) -> None:
    begin_s = bench.clock.now_s() + 0.1
    device = bench.connect("wrist_ft", fault={"kind": "stale", "at_s": begin_s})
    bench.clock.sleep(0.5)
    assert device.read_wrench(deadline=bench.deadline()).host_time_s == pytest.approx(begin_s, abs=1e-9)


def test_every_device_takes_faults(bench: SimCell) -> None:
    for name in bench.cell.file.devices:
        assert isinstance(bench.connect(name), FaultInjection)


@pytest.mark.parametrize(
    ("name", "options", "key"),
    [
        ("wrist_ft", {"fault": {"kind": "silly"}}, "fault.kind"),
        ("wrist_ft", {"force_sigma": 1.0}, "force_sigma"),
        ("wrist_camera", {"width_px": 0}, "width_px"),
        ("arm", {"model": "puma"}, "model"),
    ],
)
def test_a_wrong_option_is_refused_by_its_key(bench: SimCell, name: str, options: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        bench.connect(name, **options)
    assert key in str(caught.value)
    assert name in str(caught.value)


def test_a_dead_world_is_an_unavailable_device() -> None:
    from tests.simbackend.rig import sim_cell

    with sim_cell() as cell:
        arm = cell.connect("arm")
        world = cell.shared.peek("world")
        assert world is not None
        assert cell.shared.why_ended() is None
        world._link.process.send_signal(signal.SIGSTOP)
        assert "suspended" in str(eventually(cell.shared.why_ended))
        world._link.process.send_signal(signal.SIGCONT)
        eventually(lambda: cell.shared.why_ended() is None)
        world._link.process.kill()
        world._link.process.wait(60.0)
        assert "has ended" in str(cell.shared.why_ended())
        with pytest.raises(DeviceUnavailable) as caught:
            cell.clock.sleep(0.1)
        assert "world" in str(caught.value)
        assert arm.health() is not None


def test_a_world_whose_cell_dies_while_it_works_ends_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    from tests.simbackend.rig import sim_cell

    with sim_cell() as cell:
        cell.connect("arm")
        world = cell.shared.peek("world")
        assert world is not None
        process = world._link.process
        process.send_signal(signal.SIGSTOP)  # later it finds the request and the closed pipe at the same time
        request = np.zeros(REQUEST)
        request[:2] = Op.STEP, 1
        os.write(world._link._stream, request.tobytes())
        world._link._pipe.close()
        process.send_signal(signal.SIGCONT)
        assert process.wait(60.0) == 0
        assert "Traceback" not in capfd.readouterr().err
