"""A motion that loses its client or a device ends in the way that the cell file chooses, on a real control thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.config import Cell, load_cell
from hal.errors import Stopped
from hal.motion import Hold, MotionLimits, MotionOutcome, MotionReport
from manipulation.control.termination import SETTLED_RAD_PER_S
from manipulation.control.way_back import BACK_M
from service.tasks.gate import GatedMover
from service.tasks.losses import Losses
from tests.manipulation.control.test_controller import forwards
from tests.manipulation.rig import Rig, make_rig, tool_pose
from tests.service.conftest import WriteCell

WAY_M = 0.05


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = make_rig()
    yield made
    made.controller.close()


def cell_of(write_cell: WriteCell, **chosen: str) -> Cell:
    keys = "".join(f'\n{key} = "{value}"' for key, value in chosen.items())
    return load_cell(write_cell(robot=True, extra=f"[safety]{keys}"))


class Scene:
    """A task on a rig, and what was stopped."""

    def __init__(self, rig: Rig, cell: Cell) -> None:
        self.rig, self.stopped = rig, list[str]()
        self.losses = Losses(cell, stop=self.stop)
        self.checked: list[str] = []
        self.gate = GatedMover(
            mover=rig.controller,
            check=lambda: None,
            after=self.losses.followed("task", lambda: self.checked.append("stop")),
        )
        self.begun_m = rig.world.tip()[0, 3]

    def stop(self, why: str) -> None:
        self.stopped.append(why)
        self.rig.latched[0] = True

    def gone_m(self) -> float:
        return float(self.rig.world.tip()[0, 3] - self.begun_m)

    def at_way(self, then: object) -> None:
        """Call `then` once when the tip has gone `WAY_M`."""
        done: list[bool] = []

        def look() -> None:
            if self.gone_m() >= WAY_M and not done:
                done.append(True)
                then()  # type: ignore[operator]

        self.rig.world.before_step = look

    def lose_client(self) -> None:
        with self.losses.of_client("task", "its client is gone"):
            self.rig.controller.cancel()


@pytest.mark.parametrize("action", ["hold", "retreat", "stop"])
def test_a_motion_without_its_client_holds_goes_back_or_is_switched_off(
    rig: Rig, write_cell: WriteCell, action: str
) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost=action))
    scene.at_way(scene.lose_client)
    report = scene.gate.execute(forwards(0.1))
    if action == "stop":
        assert scene.stopped == ["its client is gone"] and not rig.world.enabled
    else:
        assert report.outcome is MotionOutcome.CANCELLED and scene.stopped == [] and rig.world.enabled
    assert (scene.gone_m() < 0.002) == (action == "retreat")
    assert np.abs(rig.world.velocity).max() < SETTLED_RAD_PER_S


@pytest.mark.parametrize(
    ("lost", "key"), [("gripper", "device_lost"), ("finger_touch", "device_lost"), ("wrist_ft", "wrench_lost")]
)
@pytest.mark.parametrize("action", ["hold", "retreat", "stop"])
def test_a_motion_that_loses_a_device_holds_goes_back_or_is_switched_off(
    rig: Rig, write_cell: WriteCell, lost: str, key: str, action: str
) -> None:
    chosen = {"device_lost": "hold", "wrench_lost": "hold", key: action}
    scene = Scene(rig, cell_of(write_cell, **chosen))
    scene.at_way(lambda: rig.world.silent.add(lost))
    report = scene.gate.execute(forwards(0.1))
    assert (report.outcome, report.device) == (MotionOutcome.FAULT, lost)
    assert [lost in why for why in scene.stopped] == ([True] if action == "stop" else [])
    assert (scene.gone_m() < 0.002) == (action == "retreat")


def test_a_motion_that_is_cancelled_or_meets_a_force_does_not_go_back(rig: Rig, write_cell: WriteCell) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost="retreat", device_lost="retreat", wrench_lost="retreat"))
    scene.at_way(rig.controller.cancel)
    assert scene.gate.execute(forwards(0.1)).outcome is MotionOutcome.CANCELLED
    assert scene.gone_m() >= WAY_M and scene.checked == []


def test_the_way_back_keeps_the_limits_of_the_motion_that_was_lost(rig: Rig, write_cell: WriteCell) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost="retreat"))
    scene.at_way(scene.lose_client)
    scene.gate.execute(replace(forwards(0.1), limits=MotionLimits(speed_m_per_s=0.02)))
    assert scene.gone_m() < 0.005
    tips = np.array([tool_pose(q).translation for q in rig.world.commands])
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / 0.002 <= 0.02 * 1.002


def test_a_stop_that_was_pressed_and_reset_meanwhile_keeps_the_arm_where_it_is(rig: Rig, write_cell: WriteCell) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost="retreat"))

    def pressed() -> None:
        raise Stopped("the software stop was pressed", hint="look")

    scene.gate = GatedMover(mover=rig.controller, check=lambda: None, after=scene.losses.followed("task", pressed))
    scene.at_way(scene.lose_client)
    assert scene.gate.execute(forwards(0.1)).outcome is MotionOutcome.CANCELLED
    assert scene.gone_m() >= WAY_M
    with scene.losses.cancelling() as may_end:
        assert may_end


def test_a_way_back_is_ended_by_the_stop_and_by_no_cancellation(rig: Rig, write_cell: WriteCell) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost="retreat"))
    asked: list[bool] = []

    def lose() -> None:
        scene.lose_client()
        rig.world.before_step = cancel_and_stop

    def cancel_and_stop() -> None:
        with scene.losses.cancelling() as may_end:
            if not may_end:
                asked.append(may_end)
        if scene.gone_m() < WAY_M / 2:
            rig.latched[0] = True

    scene.at_way(lose)
    with suppress(Stopped):
        scene.gate.execute(forwards(0.1))
    assert asked, "the task was cancelled all the time"
    assert 0.0 < scene.gone_m() < WAY_M / 2 and not rig.world.enabled


def test_the_way_back_leads_over_several_motions_and_not_further_than_it_may(rig: Rig, write_cell: WriteCell) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost="retreat"))
    for _ in range(2):
        scene.gate.execute(forwards(0.04, start=rig.world.q.copy()))
    begun_m = scene.gone_m()
    scene.begun_m += begun_m
    scene.at_way(scene.lose_client)
    scene.gate.execute(forwards(0.1, start=rig.world.q.copy()))
    back_m = WAY_M - scene.gone_m()
    assert BACK_M - 0.02 < back_m <= BACK_M + 0.005
    assert begun_m == pytest.approx(0.08, abs=1e-3)


def test_an_arm_that_has_not_moved_has_no_way_back(rig: Rig, write_cell: WriteCell, tmp_path: Path) -> None:
    scene = Scene(rig, cell_of(write_cell, client_lost="retreat"))
    rig.world.before_step = lambda: scene.lose_client() if rig.world.ticks == 20 else None
    report: MotionReport = scene.gate.execute(Hold(name="hold", duration_s=1.0))
    assert report.outcome is MotionOutcome.CANCELLED and scene.checked == []
