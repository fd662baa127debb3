"""A deed for which the hand has no room is refused before anything moves, and no other one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hal.errors import NoRoom, Unprovable, Unsupported
from hal.geometry import certain, transform_rpy
from hal.motion import RobotState
from hal.panel import Panel
from hal.strict import validate
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.hand import Hand
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.context import SkillContext
from manipulation.skills.operate import operate
from manipulation.skills.outcome import ObjectState
from manipulation.skills.rehearsal import out_of_reach_m, rehearse
from service.sweep.draw import draw_panel
from tests.manipulation.arms import T3
from tests.manipulation.rig import HOME

ARM = Kinematics.of(T3)
LEVER = {
    "kind": "lever", "name": "valve", "length_m": 0.07, "height_m": 0.03,
    "states": [{"name": "open", "angle_rad": 0.0}, {"name": "closed", "angle_rad": 1.5708}],
}  # fmt: skip
SCALE = {"minimum": 0.0, "maximum": 100.0, "unit": "%", "at_min": -0.04, "at_max": 0.04}
CONTROLS: dict[str, tuple[dict[str, Any], list[str | float]]] = {
    "button": ({"kind": "button", "radius_m": 0.012, "latching": True}, ["pressed", "released"]),
    "toggle": ({"kind": "toggle"}, ["on", "off"]),
    "slider": ({"kind": "slider", "travel_m": 0.08, "scale": SCALE}, [2.0, 50.0, 98.0]),
    "rotary": (
        {"kind": "rotary", "radius_m": 0.018, "states": [{"name": "a", "angle_rad": -0.8}, {"name": "b", "angle_rad": 0.8}]},
        ["a", "b"],
    ),
    "handwheel": ({"kind": "handwheel", "radius_m": 0.04}, [0.0, 1.5]),
    "mushroom": ({"kind": "mushroom"}, ["pressed"]),
    "lever": (LEVER, ["open", "closed"]),
}  # fmt: skip


def panel_with(*objects: dict[str, Any]) -> Panel:
    data = {"schema": 1, "name": "p", "width_m": 1.0, "height_m": 1.0, "objects": list(objects)}
    return validate(data, Panel, source="test")


def control(kind: str) -> dict[str, Any]:
    return {**CONTROLS[kind][0], "name": "one", "position_m": [0.0, 0.0]}


def post(x: float, y: float, *, half_m: float = 0.01, height_m: float = 0.05) -> dict[str, Any]:
    """Return a thick mushroom that stands in the way."""
    return {"kind": "mushroom", "name": "post", "position_m": [x, y], "radius_m": half_m, "height_m": height_m}


@pytest.mark.parametrize("kind", CONTROLS)
def test_a_control_that_stands_alone_has_room(kind: str) -> None:
    panel = panel_with(control(kind))
    for goal in CONTROLS[kind][1]:
        rehearse(ARM, panel, Hand(), panel.object("one"), goal)


@pytest.mark.parametrize("seed", range(60_001, 60_006))
def test_no_deed_of_a_random_panel_is_refused(seed: int) -> None:
    panel = validate(draw_panel(seed).stated, Panel, source="a random panel")
    for one in panel.objects:
        goal = one.goal
        if goal is None:
            continue
        goals = getattr(goal, "states", None) or [
            goal.low + share * (goal.high - goal.low) for share in (0.05, 0.5, 0.95)
        ]
        for each in goals:
            rehearse(ARM, panel, Hand(), one, each)


def test_a_toggle_beside_a_post_is_refused_with_what_is_in_the_way_and_by_how_much() -> None:
    panel = panel_with(control("toggle"), post(0.0, 0.040), post(0.0, -0.040) | {"name": "other"})
    with pytest.raises(NoRoom, match=r"one stands too near to (post|other): .* lacks \d+\.\d mm") as refused:
        rehearse(ARM, panel, Hand(), panel.object("one"), "on")
    lacks = refused.value.details["lacks_mm"]
    further = 1e-3 * (lacks + 0.1)
    freed = panel_with(control("toggle"), post(0.0, 0.040 + further), post(0.0, -0.040 - further) | {"name": "other"})
    rehearse(ARM, freed, Hand(), freed.object("one"), "on")
    nearly = panel_with(
        control("toggle"), post(0.0, 0.040 + further - 3e-4), post(0.0, -0.040 - further + 3e-4) | {"name": "other"}
    )
    with pytest.raises(NoRoom):
        rehearse(ARM, nearly, Hand(), nearly.object("one"), "on")


def test_a_stroke_that_needs_an_open_hand_is_refused_for_one_rigid_finger() -> None:
    panel = panel_with(control("rotary"))
    with pytest.raises(Unsupported, match="one rigid finger"):
        rehearse(ARM, panel, Hand(fingers=1, max_width_m=0.0), panel.object("one"), "a")


class _Stays:
    """A mover whose first motion ends the skill: the stroke was not refused."""

    class Began(Exception):
        pass

    def execute(self, motion: Any) -> Any:
        raise self.Began(motion.name)

    def cancel(self) -> None:
        return None

    def tare(self) -> Any:
        raise self.Began

    def state(self) -> Any:
        return RobotState(
            stamp_s=0.0, position_rad=HOME, velocity_rad_per_s=np.zeros(6), base_from_flange=ARM.flange(HOME),
            wrench=np.zeros(6), contacts=(), proximity_m=(), gripper_width_m=0.0, is_moving=False, is_stopped=False,
        )  # fmt: skip


POSE = transform_rpy((0.85, 0.0, 0.6), (np.pi / 2, 0.0, -np.pi / 2))


@pytest.mark.parametrize("kind", sorted(set(CONTROLS) - {"handwheel"}))  # whose many holds take five seconds to refuse
def test_what_is_refused_would_have_been_refused_by_the_skill_too(kind: str) -> None:
    """Close rings of posts around a control: where the rehearsal refuses, so does the skill with its arm."""
    half, refused = panel_with(control(kind)).object("one").half_footprint_m, 0
    for beyond_m in (0.006, 0.009, 0.012, 0.018):
        x, y = half[0] + beyond_m, half[1] + beyond_m
        places = [(sx * share * x, sy * y) for sx in (-1, 1) for sy in (-1, 1) for share in (0.3, 1.0)]
        places += [(sx * x, 0.0) for sx in (-1, 1)]
        ring = [post(*place, half_m=0.003, height_m=0.15) | {"name": f"post_{k}"} for k, place in enumerate(places)]
        panel = panel_with(control(kind), *ring)
        goal, *others = CONTROLS[kind][1]
        try:
            rehearse(ARM, panel, Hand(), panel.object("one"), goal)
        except NoRoom:
            refused += 1
            for other in others or ["released"]:
                assert _outcome(panel, goal, other) == "unreachable"
    assert refused


def _outcome(panel: Panel, goal: str | float, other: str | float) -> str:
    """Return how the skill ends with a real arm, from another state or value; `begun` once it moves there."""
    number = other if isinstance(other, float) else None
    now = ObjectState(
        name="one", state=str(other), value=number,
        angle_rad=panel.object("one").resting_angles.get(str(other), number),
    )  # fmt: skip
    context = SkillContext(
        mover=_Stays(), kinematics=ARM, panel=panel, base_from_panel=certain(POSE),
        flange_from_grip=transform_rpy((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)),
        limits=SpeedLimits(tip_m_per_s=0.25), park_rad=HOME,
    )  # fmt: skip
    try:
        return operate(context, panel.object("one"), goal, current=now).outcome
    except _Stays.Began as motion:
        return "begun" if str(motion).startswith("to ") else "unreachable"  # it moves back where it found no way


def test_the_reach_is_a_bound_of_the_arm() -> None:
    grip = transform_rpy((0.0, 0.0, 0.2), (0.0, 0.0, 0.0))
    rng = np.random.default_rng(3)
    for q in rng.uniform(ARM.lower_rad, ARM.upper_rad, (200, 6)):
        assert out_of_reach_m(ARM, grip, ARM.tool(q, grip).translation) <= 1e-9
    far = np.array([5.0, 0.0, 0.5])
    beyond = out_of_reach_m(ARM, grip, far)
    assert out_of_reach_m(ARM, grip, far + np.array([0.1, 0.0, 0.0])) > beyond + 0.09 > 0.0


@pytest.mark.parametrize(
    ("control", "goal", "why"),
    [
        ({"kind": "slider", "travel_m": 0.012, "scale": SCALE | {"at_min": -0.006, "at_max": 0.006}}, 50.0, "2 % of its way"),
        ({"kind": "button", "radius_m": 0.012, "latching": True, "travel_m": 0.001}, "pressed", "stays only 0.6 mm deeper"),
        ({"kind": "mushroom", "travel_m": 0.0015}, "pressed", "stays only 0.9 mm deeper"),
        ({"kind": "toggle", "bat_length_m": 0.006, "tilt_rad": 0.1}, "on", "moves by only 1.2 mm"),
    ],
)  # fmt: skip
def test_a_goal_that_nothing_could_confirm_is_refused(control: dict[str, Any], goal: str | float, why: str) -> None:
    panel = panel_with(control | {"name": "one", "position_m": [0.0, 0.0]})
    with pytest.raises(Unprovable, match=why):
        rehearse(ARM, panel, Hand(), panel.object("one"), goal)
