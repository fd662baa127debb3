"""The paper's direct pose and ours are both exact without noise, and ours is more accurate with noise."""

from __future__ import annotations

import numpy as np
import pytest

from examples.paper import direct_pose as paper
from hal.camera_model import project


def test_without_noise_the_direct_pose_is_the_truth() -> None:
    rotation, translation_m = np.diag([1.0, -1.0, -1.0]), np.array([0.02, -0.01, 0.8])
    pixels = project(paper.LIGHTS_M @ rotation.T + translation_m, paper.CAMERA)
    found, place_m = paper.direct_pose(paper.LIGHTS_M, pixels, paper.CAMERA)
    np.testing.assert_allclose(found, rotation, atol=1e-3)
    np.testing.assert_allclose(place_m, translation_m, atol=1e-4)


def test_all_four_lights_together_are_nearer_at_every_tilt(capsys: pytest.CaptureFixture[str]) -> None:
    for tilt_deg, (turn, our_turn, place, our_place) in paper.table():
        assert turn > 1.1 * our_turn and place > 1.1 * our_place, tilt_deg
        assert our_turn < 1.5 and our_place < 3.0
    paper.main()
    assert capsys.readouterr().out.count("\n") == 2 + len(paper.TILTS_DEG)
