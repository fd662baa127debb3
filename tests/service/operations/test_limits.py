"""Each motion of a mission has the limits of the mission, so that the control thread can keep them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from hal.motion import DeclaredMotion, Hold, MotionLimits
from service.operations.session import NotedMover, OperationContext, Session


class Mover:
    """Notes the motions that reach it."""

    def __init__(self) -> None:
        self.given: list[DeclaredMotion] = []

    def execute(self, motion: DeclaredMotion) -> Any:
        self.given.append(motion)
        return SimpleNamespace(name=motion.name)


def test_the_limits_of_a_mission_come_with_each_of_its_motions(tmp_path: Path) -> None:
    limits, mover = MotionLimits(speed_m_per_s=0.05, force_n=20.0), Mover()
    task = SimpleNamespace(check_cancelled=lambda: None)
    context = OperationContext(
        connection=cast(Any, SimpleNamespace(mover=mover)), task=cast(Any, task), runs_dir=tmp_path, limits=limits
    )
    session = cast(Session, SimpleNamespace(context=context, note=lambda _report: None))
    NotedMover(cast(Any, mover), session).execute(Hold(name="still", duration_s=0.1))
    assert [motion.limits for motion in mover.given] == [limits]
