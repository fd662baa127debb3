"""Line drawings show what a camera would see, and no more."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from examples.table2 import outlines
from fusion.draw import Drawing, box_outlines, circle_outline, seen, sight_of, svg
from hal.geometry import transform
from tests.fusion.mixtures import mixture


def test_a_drawing_is_valid_svg_with_every_visible_line() -> None:
    pose = transform(np.eye(3), (0.5, 0.0, 0.3))
    sight = sight_of(pose, (0.4, 0.25, 0.0), distance_m=1.6)
    drawing = Drawing(base_from_object=pose, outlines_m=outlines(), label="actual <1>", dashed=True)
    root = ElementTree.fromstring(svg([drawing], sight, title="a & b"))  # noqa: S314 - our own text
    lines = [e for e in root if e.tag.endswith("polyline")]
    assert len(lines) == len(outlines())
    assert any(e.text == "actual <1>" for e in root)
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
