"""Warming up runs the hot loops on something that they can really work on."""

from __future__ import annotations

import pytest

from perception.vision import warm as vision
from perception.vision.photographs.photo_display import read_photographed_display
from service.warm import STAGES


@pytest.mark.parametrize("stage", ["planning", "vision"])
def test_a_stage_runs_through(stage: str) -> None:
    STAGES[stage]()


def test_the_picture_that_warms_the_display_reader_is_read() -> None:
    assert read_photographed_display(vision.three_eights(), scene=True).text == "88.8"
