"""What is too dark or too bright to be read is looked at with another exposure, on the simulated cell."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.behind_cables import open_session, verdict
from hal.camera_settings import CameraSettings
from hal.config import load_cell
from hal.errors import NotObservable
from service.operations import inspect
from service.operations.acquisition import better_exposure_s, exposed
from service.operations.locate import go_to_overview, locate_from_overview
from service.operations.session import Session

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.timeout(300)
NAMES = ("pressure", "temperature", "flow")
RIGHT_S = 0.01


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """Yield a session with the panel of seed 9 located."""
    cell = load_cell(ROOT / "cells/bench.toml", seed=9)
    with open_session(cell, tmp_path_factory.mktemp("exposures")) as session:
        yield session


def exposure_s(session: Session) -> float | None:
    settings: CameraSettings = session.connection.device("wrist_camera").capabilities().settings
    return settings.exposure_s


def read(session: Session) -> inspect.Inspection:
    for name in NAMES:
        session.world.forget_reading(name)
    return inspect.close_ups(session, NAMES)


@pytest.mark.parametrize("light", [0.05, 8.0])
def test_the_panel_is_found_in_light_that_is_wrong_by_a_factor(session: Session, light: float) -> None:
    true = session.connection.device("arm").truth().base_from_panel_matrix
    with exposed(session, "wrist_camera", light * RIGHT_S):
        go_to_overview(session)
        found = locate_from_overview(session).base_from_panel.parent_from_child
    assert np.linalg.norm(found.translation - true[:3, 3]) < 0.003
    assert exposure_s(session) == RIGHT_S


@pytest.mark.parametrize("light", [0.02, 0.05, 8.0, 20.0])
def test_instruments_are_read_in_light_that_is_wrong_by_a_factor(session: Session, light: float) -> None:
    truth = {one.name: one for one in session.connection.device("arm").truth().objects}
    with exposed(session, "wrist_camera", light * RIGHT_S):
        found = read(session)
        assert exposure_s(session) == light * RIGHT_S, "the exposure of before is set again"
    assert [verdict(found.readings[name], session.panel.object(name), truth[name]) for name in NAMES] == ["right"] * 3
    assert exposure_s(session) == RIGHT_S


def test_what_was_read_in_the_first_look_is_not_looked_at_again(session: Session) -> None:
    assert not any("exposure" in picture.title for picture in read(session).pictures)


def test_a_camera_whose_exposure_cannot_be_set_is_asked_for_nothing(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    with exposed(session, "wrist_camera", 0.02 * RIGHT_S), monkeypatch.context() as patch:
        patch.setattr(inspect, "in_better_light", lambda *_: None)
        with pytest.raises(NotObservable, match="black"):
            read(session)


class Camera:
    """Camera with an exposure of 10 ms, or one that tells none."""

    def __init__(self, range_s: tuple[float, float] | None) -> None:
        settings = CameraSettings(exposure_s=RIGHT_S, exposure_range_s=range_s)
        self.capabilities = lambda: SimpleNamespace(settings=settings)


@pytest.mark.parametrize(
    ("gray", "range_s", "factor"),
    [
        (90, (1e-4, 1.0), 2.0),
        (18, (1e-4, 1.0), 8.0),
        (18, (1e-4, 0.03), 3.0),  # the longest of the camera
        (255, (1e-4, 1.0), 0.3),
        (255, (0.005, 1.0), 0.5),
        (150, (1e-4, 1.0), None),
        (18, (1e-4, 0.011), None),  # a camera that cannot do better
        (18, None, None),
    ],
)
def test_the_exposure_brings_the_bright_parts_of_what_is_not_read_to_one_level(
    gray: int, range_s: tuple[float, float] | None, factor: float | None
) -> None:
    pixels = np.full((120, 160), 180, np.uint8)
    pixels[20:40, 10:30] = gray
    seen: Any = SimpleNamespace(camera="eye", pixels=pixels)
    camera = Camera(range_s)
    session: Any = SimpleNamespace(connection=SimpleNamespace(device={"eye": camera}.__getitem__))
    box = np.array([[10.0, 20.0], [30.0, 40.0]])
    found = better_exposure_s(session, seen, [box])
    assert found == (None if factor is None else pytest.approx(factor * RIGHT_S))
    outside = better_exposure_s(session, seen, [box + 500.0, np.full((2, 2), np.nan)])
    assert outside is None, "the whole image counts, which is mostly bright enough"
