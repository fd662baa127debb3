"""Before driving to one of several poses, quick searches are tried for all poses before a long one for any."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.behind_cables import open_session
from hal.config import load_cell
from hal.errors import Unreachable
from manipulation.planning.transfer import QUICK, THOROUGH, Effort
from manipulation.skills.context import SkillContext
from manipulation.skills.travel import MOST_THOROUGH, MOST_TRIES, NEAR_RAD, near_first
from perception.vision.viewpoints import close_up_poses
from service.operations.session import Session
from service.operations.travel import go_to_camera_view

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """Yield a session with the panel located."""
    with open_session(load_cell(ROOT / "cells/bench.toml", seed=3), tmp_path_factory.mktemp("travel")) as session:
        yield session


def efforts_of(session: Session, monkeypatch: pytest.MonkeyPatch, *, found_at: int) -> list[Effort]:
    """Return the efforts of all searches if search number `found_at` finds a path, which the arm drives."""
    asked: list[Effort] = []
    transfer = SkillContext.transfer

    def search(cell: SkillContext, *args: Any, effort: Effort, **kwargs: Any) -> Any:
        asked.append(effort)
        if len(asked) - 1 != found_at:
            raise Unreachable("no way", hint="none")
        return transfer(cell, *args, effort=effort, **kwargs)

    monkeypatch.setattr(SkillContext, "transfer", search)
    poses = close_up_poses(session.known_panel().parent_from_child, (0.0, 0.0, 0.0))
    go_to_camera_view(session, poses, name="a close-up")
    return asked


def test_views_near_by_go_before_those_of_another_branch_of_the_arm() -> None:
    """A view for which the arm must flip takes 3.9 s; the same view with the camera on its side takes 1.4 s."""
    here = np.zeros(6)
    asked = []

    def goals() -> Iterator[Any]:
        for turn_rad in (2.0, NEAR_RAD, -NEAR_RAD - 0.01, 0.3):
            asked.append(turn_rad)
            yield np.array([0.1, turn_rad, 0.0, 0.0, 0.0, 0.0])

    order = near_first(goals(), here)
    assert next(order)[1] == NEAR_RAD and asked == [2.0, NEAR_RAD], "no more poses are worked out than are tried"
    assert [goal[1] for goal in order] == [0.3, 2.0, -NEAR_RAD - 0.01]


def test_the_next_pose_is_tried_before_a_long_search_for_the_first(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = session.mover.state().position_rad
    assert efforts_of(session, monkeypatch, found_at=2) == [QUICK] * 3
    assert np.abs(session.mover.state().position_rad - before).max() > 0.05


def test_without_any_way_the_searches_end(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Effort] = []

    def search(*_: Any, effort: Effort, **__: Any) -> Any:
        asked.append(effort)
        raise Unreachable("no way", hint="none")

    monkeypatch.setattr(SkillContext, "transfer", search)
    poses = close_up_poses(session.known_panel().parent_from_child, (0.0, 0.0, 0.0))
    with pytest.raises(Unreachable, match="a close-up: no way"):
        go_to_camera_view(session, poses, name="a close-up")
    assert 0 < asked.count(QUICK) <= MOST_TRIES
    assert asked[asked.count(QUICK) :] == [THOROUGH] * min(MOST_THOROUGH, asked.count(QUICK))
