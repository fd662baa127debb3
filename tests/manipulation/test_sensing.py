from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from hal.clock import PacedClock, SimClock, WallClock
from hal.errors import DeviceTimeout, StaleReading
from manipulation.sensing import ContactWrench, RangeReader, read_wait_s
from tests.manipulation.rig import LOAD, SENSOR, FakeProximity, World

PATIENCE_S = 0.3


def reader(world: World) -> RangeReader:
    return RangeReader(FakeProximity("near", world), world.clock, max_age_s=0.1, patience_s=PATIENCE_S)


def world_with_wall() -> World:
    world = World(clock=SimClock())
    world.wall_x_m = float(world.tip()[0, 3]) + 0.05
    return world


def test_a_missed_beat_is_bridged_and_silence_is_not() -> None:
    world = world_with_wall()
    sensor = reader(world)
    assert sensor.read(0.0) == pytest.approx(0.05)
    world.silent.add("near")
    assert sensor.read(0.9 * PATIENCE_S) == pytest.approx(0.05)
    with pytest.raises(DeviceTimeout, match="near"):
        sensor.read(1.1 * PATIENCE_S)


def test_a_sensor_that_never_spoke_is_not_waited_for() -> None:
    world = world_with_wall()
    world.silent.add("near")
    with pytest.raises(DeviceTimeout):
        reader(world).read(0.0)


def test_an_old_stamp_counts_as_silence() -> None:
    world = world_with_wall()
    sensor = reader(world)
    sensor.read(0.0)
    world.frozen.add("near")
    assert sensor.read(0.2) == pytest.approx(0.05)
    with pytest.raises(StaleReading):
        sensor.read(0.31)


def test_a_tick_waits_long_for_a_device_only_where_the_world_waits_too() -> None:
    picture_s, watchdog_s = 0.15, 0.1
    assert read_wait_s(PacedClock()) > picture_s
    assert read_wait_s(WallClock()) < watchdog_s


def test_nothing_in_range_is_an_answer() -> None:
    world = world_with_wall()
    world.wall_x_m = math.inf
    assert math.isnan(reader(world).read(0.0))


@given(turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3))
@settings(max_examples=40, deadline=None)
def test_at_rest_in_any_posture_weight_and_bias_leave_no_contact(turn: list[float]) -> None:
    flange = RigidTransform.from_components([0.1, 0.2, 0.3], Rotation.from_rotvec(turn))
    sensor = flange * SENSOR
    gravity = sensor.rotation.inv().apply([0.0, 0.0, -9.80665 * LOAD.mass_kg])
    raw = np.concatenate([gravity, np.cross(LOAD.centre_of_mass_m, gravity)]) + np.asarray(LOAD.bias)
    found = ContactWrench(LOAD, SENSOR).in_flange(raw, np.ascontiguousarray(flange.as_matrix()))
    assert np.abs(found).max() < 1e-9
