"""Line drawings show what a camera would see, without the parts behind it."""

from __future__ import annotations

import numpy as np
import pytest

from examples.paper.outlines import Drawing, box_outlines, circle_outline, seen, sight_of
from examples.paper.table2 import outlines
from hal.geometry import transform
from tests.fusion.mixtures import mixture


def test_a_drawing_shows_every_visible_line_within_the_image() -> None:
    pose = transform(np.eye(3), (0.5, 0.0, 0.3))
    sight = sight_of(pose, (0.4, 0.25, 0.0), distance_m=1.6)
    drawing = Drawing(base_from_object=pose, outlines_m=outlines(), label="actual", dashed=True)
    assert len(seen(drawing, sight)) == len(outlines())
    for polyline in seen(drawing, sight):
        assert (polyline > 0).all()
        assert (polyline < (sight.width_px, sight.height_px)).all()


def test_the_middle_is_drawn_in_the_middle() -> None:
    pose = mixture(1, 14).base_from_object
    sight = sight_of(pose, (0.1, 0.2, 0.0), distance_m=1.0)
    dot = Drawing(base_from_object=pose, outlines_m=[circle_outline((0.1, 0.2, 0.0), 1e-6)])
    assert seen(dot, sight)[0].mean(axis=0) == pytest.approx((320, 240), abs=0.1)


def test_what_is_behind_the_lens_is_cut_off() -> None:
    pose = transform(np.eye(3), np.zeros(3))
    sight = sight_of(pose, (0.0, 0.0, 0.0), distance_m=0.1)
    through = Drawing(base_from_object=pose, outlines_m=box_outlines((-1, -1, -1), (1, 1, 1)))
    assert all(np.isfinite(line).all() for line in seen(through, sight))
