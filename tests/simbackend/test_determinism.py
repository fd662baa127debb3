"""The same seed and motions give identical bits, in another process and with an additional reader."""

from __future__ import annotations

import hashlib

import numpy as np

from tests.simbackend.rig import BENCH, SimCell, sim_cell


def script(cell: SimCell, *, curious: bool = False) -> str:
    """Run a short closed loop over every device; return a hash of all readings."""
    devices = {name: cell.connect(name) for name in cell.cell.file.devices}
    arm, force, lights = devices["arm"], devices["wrist_ft"], devices["panel_lights"]
    digest = hashlib.sha256()
    arm.enable(deadline=cell.deadline())
    q = arm.read_state(deadline=cell.deadline()).value.position_rad
    for i in range(60):
        wrench = force.read_wrench(deadline=cell.deadline()).value
        # The measured force controls the motion, so that one different bit of noise would change everything.
        q = q + np.array([2e-4, 1e-4, 0, 0, 1e-4, 1e-6 * wrench.force_n[0]])
        arm.command_position(q, deadline=cell.deadline())
        if i == 30:
            lights.set_on([True, False, True, False], deadline=cell.deadline())
        if curious and i % 10 == 0:
            devices["wrist_camera"].read_image(deadline=cell.deadline())
            devices["range_scanner"].read_range(deadline=cell.deadline())
        cell.clock.sleep(0.002)
        state = arm.read_state(deadline=cell.deadline()).value
        distance = devices["proximity_left"].read_distance_m(deadline=cell.deadline()).value
        for array in (
            state.position_rad,
            state.velocity_rad_per_s,
            wrench.force_n,
            wrench.torque_nm,
            np.array(distance),
        ):
            digest.update(array.tobytes())
    digest.update(devices["wrist_camera"].read_image(deadline=cell.deadline()).value.pixels.tobytes())
    digest.update(devices["range_scanner"].read_range(deadline=cell.deadline()).value.depth_m.tobytes())
    return digest.hexdigest()


def test_two_worlds_of_one_seed_agree_in_every_bit_and_readers_change_nothing() -> None:
    hashes = []
    for curious in (False, True):
        with sim_cell(BENCH, seed=5) as cell:
            hashes.append(script(cell, curious=curious))
    with sim_cell(BENCH, seed=6) as cell:
        other = script(cell)
    assert hashes[0] == hashes[1]
    assert other != hashes[0]


def test_reading_lets_no_time_pass(bench: SimCell) -> None:
    before_s = bench.clock.now_s()
    for name in ("wrist_camera", "range_scanner"):
        device = bench.connect(name)
        read = device.read_image if name == "wrist_camera" else device.read_range
        first, second = read(deadline=bench.deadline()), read(deadline=bench.deadline())
        assert first.host_time_s == second.host_time_s == before_s
    assert bench.clock.now_s() == before_s


def test_sleep_passes_the_time_that_was_asked_for_on_average(bench: SimCell) -> None:
    start_s = bench.clock.now_s()
    for _ in range(40):
        bench.clock.sleep(0.0033)
    assert abs(bench.clock.now_s() - start_s - 40 * 0.0033) <= 0.002 + 1e-9
