"""Tests of the detents that are counted in the torque of a selector."""

from __future__ import annotations

import numpy as np
import pytest

from manipulation.skills.rotary import detents_passed


@pytest.mark.parametrize("detents", [0, 1, 3])
@pytest.mark.parametrize("effort_nm", [0.08, 0.3])
def test_each_fall_of_the_torque_is_one_detent(detents: int, effort_nm: float) -> None:
    """The pads load up to the middle between two places, then the selector runs ahead to the next."""
    resists = np.concatenate([np.linspace(0.0, effort_nm, 40), np.full(30, effort_nm)])
    snaps = np.linspace(-0.5 * effort_nm, 0.0, 20)
    torque = np.concatenate([*([resists, snaps] * detents), 0.4 * resists])
    noise = 0.004 * np.random.default_rng(5).standard_normal(len(torque))
    assert detents_passed(torque + noise) == detents
