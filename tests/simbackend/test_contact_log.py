"""The contact log adds up the engine's contact points by body, and answers for the time since any block."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from simbackend.contact_log import BLOCKS, ContactLog, contacts_of
from simbackend.urdf import at, box, inertial, joint, link, shape
from simbackend.world import _quiet_pybullet

UP, RIGHT = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
NONE = (0.0, 1.0, 0.0)


def point(body: int, force_n: float, normal: tuple[float, float, float] = UP, slide_n: float = 0.0) -> tuple[Any, ...]:
    """Return a contact as the engine has it: body, normal, normal force, and friction along two directions."""
    return (0, 1, body, 7, None, None, None, normal, 0.0, force_n, slide_n, RIGHT, 0.0, NONE)


@pytest.fixture
def log() -> ContactLog:
    return ContactLog({"lever": 3, "knob": 5}, 0.002)


def test_forces_on_a_body_add_up_as_vectors(log: ContactLog) -> None:
    log.note([point(3, 3.0), point(3, 4.0, RIGHT), point(5, 1.0, slide_n=1.0)])
    contact = log.since(0.0)
    assert contact.peaks_n == pytest.approx({"lever": 5.0, "knob": math.sqrt(2.0)})
    assert contact.peak_n == pytest.approx(math.hypot(5.0, 4.0))
    assert contact.impulse_n_s == pytest.approx(0.002 * math.hypot(5.0, 4.0))


def test_chatter_is_the_change_from_tick_to_tick_within_a_contact(log: ContactLog) -> None:
    for force_n in (10.0, 13.0, 9.0):
        log.note([point(3, force_n)])
    log.nothing()
    log.note([point(3, 50.0)])  # a new contact, not a change of force
    assert log.since(0.0).chatter_n == pytest.approx(math.sqrt((9.0 + 16.0) / 2))


def test_blocks_before_the_time_asked_for_do_not_count(log: ContactLog) -> None:
    log.note([point(3, 80.0)])
    log.end_block(100)
    log.note([point(5, 20.0)])
    log.end_block(200)
    log.note([point(5, 5.0)])
    assert log.since(0.2).peaks_n == {"knob": 20.0}
    assert log.since(0.0).peaks_n == {"lever": 80.0, "knob": 20.0}
    assert log.since(0.4).peak_n == 5.0
    assert log.peak_n == 80.0


def test_time_without_contact_does_not_drive_out_the_contacts(log: ContactLog) -> None:
    log.note([point(3, 80.0)])
    log.end_block(100)
    for block in range(2 * BLOCKS):
        log.nothing()
        log.end_block(100 * (block + 2))
    assert log.since(0.0).peaks_n == {"lever": 80.0}
    assert log.since(0.2).peak_n == 0.0


def test_without_contact_all_is_zero(log: ContactLog) -> None:
    log.nothing()
    assert (log.since(0.0).peak_n, log.since(0.0).chatter_n, log.since(0.0).peaks_n) == (0.0, 0.0, {})


@pytest.mark.parametrize("order", [("arm", "ground"), ("ground", "arm")])
def test_friction_balances_a_push_whichever_body_the_engine_has_first(tmp_path: Path, order: tuple[str, str]) -> None:
    """A box of 1 kg on another one is pushed with 1.5 N and stands still, so friction pushes it back with 1.5 N."""
    solid = shape(at(0, 0, 0), box((0.2, 0.2, 0.1)), (0.5, 0.5, 0.5))
    mass = inertial(1.0, (0, 0, 0), (0.1, 0.1, 0.1))
    slides = [
        *(*link("root", mass), *link("one", mass), *link("two", mass, solid)),
        *joint("x", "prismatic", "root", "one", at(0, 0, 0), axis=(1, 0, 0), limits=(-1, 1)),
        *joint("z", "prismatic", "one", "two", at(0, 0, 0), axis=(0, 0, 1), limits=(-1, 1)),
    ]
    for name, lines in (("arm", slides), ("ground", link("base", mass, solid))):
        (tmp_path / f"{name}.urdf").write_text("\n".join([f'<robot name="{name}">', *lines, "</robot>"]))
    engine = _quiet_pybullet()
    engine.connect(engine.DIRECT)
    try:
        engine.setGravity(0.0, 0.0, -9.81)
        height_m = {"arm": 0.1, "ground": 0.0}
        body = {
            name: engine.loadURDF(str(tmp_path / f"{name}.urdf"), (0.0, 0.0, height_m[name]), useFixedBase=True)
            for name in order
        }
        engine.setJointMotorControlArray(body["arm"], (0, 1), engine.VELOCITY_CONTROL, forces=(0.0, 0.0))
        for _ in range(200):
            engine.setJointMotorControl2(body["arm"], 0, engine.TORQUE_CONTROL, force=1.5)
            engine.stepSimulation()
        contacts = contacts_of(engine.getContactPoints(), body["arm"])
    finally:
        engine.disconnect()
    pairs = [pair for c in contacts for pair in ((c[9], c[7]), (c[10], c[11]), (c[12], c[13]))]
    assert [sum(n * way[axis] for n, way in pairs) for axis in range(3)] == pytest.approx([-1.5, 0.0, 9.81], abs=0.01)
