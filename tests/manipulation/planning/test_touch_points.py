"""Points to touch are on the bare plate and far apart."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from hal.errors import NotFound
from hal.panel import Panel, load_panel
from manipulation.planning.touch_points import EDGE_M, touch_points

PANEL = load_panel(Path(__file__).parents[3] / "panels/bench.toml")


@pytest.mark.parametrize("count", [3, 4, 6])
def test_spots_are_bare_and_far_apart(count: int) -> None:
    spots = touch_points(PANEL, count)
    assert len(spots) == count
    for x, y in spots:
        assert abs(x) <= PANEL.width_m / 2 - EDGE_M + 1e-9 and abs(y) <= PANEL.height_m / 2 - EDGE_M + 1e-9
        for panel_object in PANEL.objects:
            half_x, half_y = panel_object.half_footprint_m
            gap = np.hypot(
                max(abs(x - panel_object.position_m[0]) - half_x, 0.0),
                max(abs(y - panel_object.position_m[1]) - half_y, 0.0),
            )
            assert gap >= 0.0299, f"{panel_object.name} is {gap:.3f} m from a spot"
    nearest = min(np.linalg.norm(a - b) for a, b in itertools.combinations(spots, 2))
    assert nearest > 0.08


def test_a_crowded_panel_has_no_spots_and_says_so() -> None:
    crowded: Panel = PANEL.model_copy(update={"width_m": 0.05, "height_m": 0.05, "lights": PANEL.lights})
    with pytest.raises(NotFound, match="bare"):
        touch_points(crowded, 3)
