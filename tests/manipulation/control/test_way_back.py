"""When the service is lost and the cell file asks for it, the control thread takes the arm back the way it came by itself."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from hal.errors import Stopped
from hal.motion import NO_LIMITS, Hold, MotionLimits, MotionOutcome, MotionReport
from manipulation.control.way_back import BACK_M, BACK_M_PER_S, LONGEST_S, Trail
from tests.manipulation.control.test_controller import forwards
from tests.manipulation.rig import HOME, Rig, make_rig, tool_pose

WAY_M = 0.05
DT_S = 0.002


class Scene:
    """A rig whose service is lost when the tip has gone `WAY_M`; then `meanwhile` is called before each step of the world."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.begun_m = rig.world.tip()[0, 3]
        self.meanwhile: Callable[[], None] = lambda: None
        self.lost_at: int | None = None  # number of set-points before
        self.goes_back = True
        rig.world.before_step = self.look

    def gone_m(self) -> float:
        return float(self.rig.world.tip()[0, 3] - self.begun_m)

    def look(self) -> None:
        if self.lost_at is None and self.gone_m() >= WAY_M:
            self.lose()
        elif self.lost_at is not None:
            self.meanwhile()

    def lose(self) -> None:
        self.lost_at = len(self.rig.world.commands)
        self.rig.latched[0], self.rig.back[0] = True, self.goes_back

    def speeds_m_per_s(self) -> np.ndarray:
        """Return the speeds of the tip from the turning point on."""
        tips = np.array([tool_pose(q).translation for q in self.rig.world.commands[self.lost_at :]])
        back = int(np.argmax(tips[:, 0]))
        return np.linalg.norm(np.diff(tips[back:], axis=0), axis=1) / DT_S


@pytest.fixture
def scene() -> Iterator[Scene]:
    rig = make_rig()
    yield Scene(rig)
    rig.controller.close()


def test_an_arm_without_its_service_goes_back_slowly_and_is_switched_off(scene: Scene) -> None:
    report = scene.rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.STOPPED
    assert scene.gone_m() < 0.002 and not scene.rig.world.enabled
    assert scene.speeds_m_per_s().max() <= 1.002 * BACK_M_PER_S
    with pytest.raises(Stopped):
        scene.rig.controller.execute(forwards(0.01))


def test_the_way_back_keeps_the_limits_of_the_motion_and_of_people_near(scene: Scene) -> None:
    scene.rig.controller.execute(replace(forwards(0.1), limits=MotionLimits(speed_m_per_s=0.02)))
    assert scene.gone_m() < 0.005
    assert scene.speeds_m_per_s().max() <= 0.02 * 1.002


@pytest.mark.parametrize("lost", ["wrist_ft", "gripper", "finger_touch", "proximity_left"])
def test_the_way_back_needs_the_arm_only(scene: Scene, lost: str) -> None:
    scene.meanwhile = lambda: scene.rig.world.silent.add(lost)
    scene.rig.controller.execute(forwards(0.1))
    assert scene.gone_m() < 0.002 and not scene.rig.world.enabled


def test_a_stop_ends_the_way_back_at_once(scene: Scene) -> None:
    def stop() -> None:
        if scene.gone_m() < WAY_M / 2:
            scene.rig.back[0] = False  # the latch stays set

    scene.meanwhile = stop
    scene.rig.controller.execute(forwards(0.1))
    assert WAY_M / 2 - 0.005 < scene.gone_m() < WAY_M / 2 and not scene.rig.world.enabled


def test_a_reset_in_the_way_back_ends_it(scene: Scene) -> None:
    def reset() -> None:
        if scene.gone_m() < WAY_M / 2:
            scene.rig.latched[0] = scene.rig.back[0] = False

    scene.meanwhile = reset
    scene.rig.controller.execute(forwards(0.1))
    assert WAY_M / 2 - 0.005 < scene.gone_m() < WAY_M / 2 and not scene.rig.world.enabled


def test_closing_and_cancelling_wait_for_the_way_back(scene: Scene) -> None:
    closing = threading.Thread(target=scene.rig.controller.close)

    def close() -> None:
        scene.rig.controller.cancel()
        if closing.ident is None:
            closing.start()
            while not scene.rig.controller._is_closing:
                pass

    scene.meanwhile = close
    scene.rig.controller.execute(forwards(0.1))
    closing.join()
    assert scene.gone_m() < 0.002 and not scene.rig.world.enabled


def test_a_way_back_that_takes_too_long_ends(scene: Scene) -> None:
    def stand_still() -> None:
        if scene.gone_m() < WAY_M / 2:
            scene.rig.world.clock.set_now_s(scene.rig.world.clock.now_s() + LONGEST_S)
            scene.meanwhile = lambda: None

    scene.meanwhile = stand_still
    scene.rig.controller.execute(forwards(0.1))
    assert WAY_M / 2 - 0.005 < scene.gone_m() < WAY_M / 2 and not scene.rig.world.enabled


def test_a_stop_of_a_person_leaves_the_arm_where_it_is(scene: Scene) -> None:
    scene.goes_back = False
    assert scene.rig.controller.execute(forwards(0.1)).outcome is MotionOutcome.STOPPED
    assert scene.gone_m() >= WAY_M and not scene.rig.world.enabled


def test_an_arm_that_stands_in_a_motion_goes_back_over_the_motions_before_it(scene: Scene) -> None:
    scene.rig.controller.execute(forwards(0.04))
    held_at = scene.rig.world.ticks
    scene.rig.world.before_step = lambda: scene.lose() if scene.rig.world.ticks == held_at + 20 else None
    scene.rig.controller.execute(Hold(name="hold", duration_s=1.0))
    assert scene.gone_m() < 0.002 and not scene.rig.world.enabled


def test_an_arm_that_has_not_moved_stays(scene: Scene) -> None:
    scene.rig.world.before_step = lambda: scene.lose() if scene.rig.world.ticks == 20 else None
    scene.rig.controller.execute(Hold(name="hold", duration_s=1.0))
    assert abs(scene.gone_m()) < 1e-6 and not scene.rig.world.enabled


def test_a_way_that_somebody_else_has_moved_the_arm_from_does_not_count() -> None:
    reports: list[MotionReport] = []
    turned = HOME + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])  # by hand, while the drives were off; the tip stayed
    for start in (HOME, turned):
        rig = make_rig()
        rig.world.q, rig.world.target = start.copy(), start.copy()
        reports.append(rig.controller.execute(forwards(0.04, start=start)))
        rig.controller.close()
    trail = Trail()
    for report in reports:
        trail.add(report)
    back = trail.way_back(NO_LIMITS)
    assert back is not None
    assert np.abs(back.positions_rad[-1] - turned).max() < 0.02
    tips = np.array([tool_pose(q).translation for q in back.positions_rad])
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).sum() < BACK_M
