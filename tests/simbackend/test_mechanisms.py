"""Compares springs, friction, detents and latches with the panel file, under a known force."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pybullet
import pytest

from hal.panel import Button, Lever, Mushroom, Scale, Slider, State, Toggle
from simbackend.bodies.body import Start, body_of
from simbackend.bodies.parts import robot
from simbackend.mechanisms import JOINT, Detent, Friction, Spring

DT_S = 0.002


class Engine:
    """PyBullet with its client's id as argument of every call."""

    def __init__(self) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        self.setPhysicsEngineParameter(fixedTimeStep=DT_S)

    def __getattr__(self, name: str) -> Any:
        found = getattr(pybullet, name)
        if not callable(found):
            return found
        return lambda *args, **keywords: found(*args, physicsClientId=self.client, **keywords)


@pytest.fixture
def engine() -> Iterator[Engine]:
    engine = Engine()
    yield engine
    pybullet.disconnect(engine.client)


def load(engine: Engine, folder: Path, panel_object: Any, place: float = 0.0) -> int:
    model = body_of(panel_object.kind).model(panel_object, Start(place=place))
    path = folder / "part.urdf"
    path.write_text(robot(model.urdf), encoding="ascii")
    flags = engine.URDF_USE_INERTIA_FROM_FILE
    flags |= engine.URDF_USE_IMPLICIT_CYLINDER if model.has_exact_cylinders else 0
    body = int(engine.loadURDF(str(path), useFixedBase=True, flags=flags))
    engine.resetJointState(body, JOINT, place)
    return body


def push(engine: Engine, body: int, effort: float, drive: Callable[[], None], seconds: float = 1.0) -> float:
    """Return the joint's position after a constant force or torque (N or N m along the joint)."""
    for _ in range(round(seconds / DT_S)):
        drive()
        # A joint torque would replace that of the spring, so the force is external, as a finger's is.
        _external(engine, body, effort)
        engine.stepSimulation()
    return float(engine.getJointState(body, JOINT)[0])


def _external(engine: Engine, body: int, effort: float) -> None:
    info = engine.getJointInfo(body, JOINT)
    along = [effort * a for a in info[13]]
    if info[2] == engine.JOINT_PRISMATIC:
        position = engine.getLinkState(body, JOINT, computeForwardKinematics=1)[0]
        engine.applyExternalForce(body, JOINT, along, position, engine.WORLD_FRAME)
    else:
        # A couple of two forces, because the engine's external torque on a fixed-base link is unreliable.
        axis = info[13]
        arm = (1.0, 0.0, 0.0) if abs(axis[0]) < 0.5 else (0.0, 1.0, 0.0)
        cross = [
            axis[1] * arm[2] - axis[2] * arm[1],
            axis[2] * arm[0] - axis[0] * arm[2],
            axis[0] * arm[1] - axis[1] * arm[0],
        ]
        half = [effort / 2.0 * c for c in cross]
        centre = engine.getLinkState(body, JOINT, computeForwardKinematics=1)[4]
        for sign in (1.0, -1.0):
            point = [c + sign * a for c, a in zip(centre, arm, strict=True)]
            engine.applyExternalForce(body, JOINT, [sign * h for h in half], point, engine.WORLD_FRAME)


def button(engine: Engine, folder: Path, **changes: Any) -> Spring:
    panel_object = Button(name="b", position_m=(0.0, 0.0), radius_m=0.012, **changes)
    body = load(engine, folder, panel_object)
    spring = Spring(
        engine=engine,
        body=body,
        travel_m=panel_object.travel_m,
        spring_n_per_m=panel_object.spring_n_per_m,
        preload_n=panel_object.preload_n,
        latching=panel_object.latching,
        releases=True,
    )
    spring.free()
    return spring


@pytest.mark.parametrize("force_n", [4.0, 5.5])
def test_a_button_sinks_by_force_less_preload_over_stiffness(engine: Engine, tmp_path: Path, force_n: float) -> None:
    spring = button(engine, tmp_path, spring_n_per_m=1000.0, preload_n=2.0)
    assert push(engine, spring.body, -force_n, spring.drive) == pytest.approx(-(force_n - 2.0) / 1000.0, abs=2e-5)


@pytest.mark.parametrize(
    "cap", [Button(name="b", position_m=(0.0, 0.0), radius_m=0.012), Mushroom(name="m", position_m=(0.0, 0.0))]
)
def test_a_cap_is_met_at_the_height_that_it_has(engine: Engine, tmp_path: Path, cap: Button | Mushroom) -> None:
    """Prisms instead of cylinders are met 1 mm above the cap, which told latched caps as released."""
    body = load(engine, tmp_path, cap)
    box = engine.createMultiBody(0, engine.createCollisionShape(engine.GEOM_BOX, halfExtents=[0.003, 0.006, 0.03]))
    engine.resetBasePositionAndOrientation(box, [0.002, 0.0, cap.height_m + 0.002 + 0.03], [0, 0, 0, 1])
    gaps = [point[8] for point in engine.getClosestPoints(box, body, 0.02)]
    assert min(gaps) == pytest.approx(0.002, abs=1e-4)


def test_less_than_the_preload_moves_no_button(engine: Engine, tmp_path: Path) -> None:
    spring = button(engine, tmp_path, preload_n=2.0)
    assert abs(push(engine, spring.body, -1.5, spring.drive)) < 2e-4


def test_a_button_counts_one_press_and_comes_back(engine: Engine, tmp_path: Path) -> None:
    spring = button(engine, tmp_path)
    push(engine, spring.body, -12.0, spring.drive)
    assert (spring.is_in, spring.presses) == (True, 1)
    assert abs(push(engine, spring.body, 0.0, spring.drive)) < 2e-4
    assert (spring.is_in, spring.presses) == (False, 1)


def test_a_latching_button_stays_in_until_pressed_again(engine: Engine, tmp_path: Path) -> None:
    spring = button(engine, tmp_path, latching=True)
    push(engine, spring.body, -12.0, spring.drive)
    assert push(engine, spring.body, 0.0, spring.drive) == pytest.approx(-spring.latched_depth_m, abs=3e-4)
    push(engine, spring.body, -12.0, spring.drive)
    assert abs(push(engine, spring.body, 0.0, spring.drive)) < 3e-4
    assert not spring.is_latched


def test_a_mushroom_latches_for_good(engine: Engine, tmp_path: Path) -> None:
    panel_object = Mushroom(name="m", position_m=(0.0, 0.0))
    body = load(engine, tmp_path, panel_object)
    spring = Spring(
        engine=engine, body=body, travel_m=0.006, spring_n_per_m=2000.0, preload_n=8.0, latching=True, releases=False
    )
    spring.free()
    for _ in range(2):
        push(engine, body, -30.0, spring.drive)
        push(engine, body, 0.0, spring.drive)
    assert spring.is_latched
    assert spring.presses == 2


@pytest.mark.parametrize(("effort", "moves"), [(3.6, False), (4.4, True)])
def test_a_slider_breaks_away_at_its_friction(engine: Engine, tmp_path: Path, effort: float, moves: bool) -> None:
    scale = Scale(minimum=0.0, maximum=100.0, unit="%", at_min=-0.05, at_max=0.05)
    panel_object = Slider(name="s", position_m=(0.0, 0.0), travel_m=0.1, scale=scale, friction_n=4.0)
    friction = Friction(engine=engine, body=load(engine, tmp_path, panel_object), effort=4.0, damping=5.0)
    place = push(engine, friction.body, effort, friction.drive)
    assert (place > 0.01) is moves
    assert place <= 0.0505


def test_a_lever_turned_too_hard_stops_at_its_ends(engine: Engine, tmp_path: Path) -> None:
    states = (State(name="open", angle_rad=0.0), State(name="closed", angle_rad=1.5708))
    lever = Lever(name="l", position_m=(0.0, 0.0), states=states)
    friction = Friction(engine=engine, body=load(engine, tmp_path, lever), effort=2.0, damping=0.05)
    assert push(engine, friction.body, 3.0, friction.drive) == pytest.approx(1.5708, abs=0.05)
    assert push(engine, friction.body, -3.0, friction.drive) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("effort_nm", "flips"), [(0.10, False), (0.14, True)])
def test_a_toggle_flips_beyond_its_effort_and_rests_at_an_end(
    engine: Engine, tmp_path: Path, effort_nm: float, flips: bool
) -> None:
    panel_object = Toggle(name="t", position_m=(0.0, 0.0))
    body = load(engine, tmp_path, panel_object, place=-panel_object.tilt_rad)
    detent = Detent(
        engine=engine, body=body, places=(-panel_object.tilt_rad, panel_object.tilt_rad), effort=0.12, max_speed=8.0
    )
    push(engine, body, effort_nm, detent.drive, 0.5)
    rest = push(engine, body, 0.0, detent.drive, 0.5)
    assert rest == pytest.approx(panel_object.tilt_rad if flips else -panel_object.tilt_rad, abs=2e-3)
