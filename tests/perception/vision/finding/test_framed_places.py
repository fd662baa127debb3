"""The rectangle around a place counts for the kinds of its width and height, and makes nothing surely recognised."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perception.vision.finding.blind import Detection, chosen, lay_out
from perception.vision.finding.features import PLATE_PX_PER_M, Ground, look_at, plate_gray
from perception.vision.finding.shapes import Rectangle, find_edges
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind
from perception.vision.look import LENGTH
from perception.vision.projection import PlateProjection

PLATE_M = (0.4, 0.3)
PLACE = np.array([[300.0, 225.0]])
WIDE_M, ROUND_M = (0.066, 0.036), (0.066, 0.066)
VIEW = PlateProjection(
    px_from_plate=np.array([[PLATE_PX_PER_M, 0.0, 300.0], [0.0, -PLATE_PX_PER_M, 225.0], [0.0, 0.0, 1.0]]),
    corners_m=np.array([[-0.2, 0.15], [0.2, 0.15], [0.2, -0.15], [-0.2, -0.15]]),
)


def frame(size_m: tuple[float, float], *, coverage: float = 1.0, off_px: float = 0.0) -> Rectangle:
    width, height = (side * PLATE_PX_PER_M for side in size_m)
    return Rectangle(u=300.0 + off_px, v=225.0, width=width, height=height, coverage=coverage)


def seen(*frames: Rectangle, size_m: tuple[float, float] = WIDE_M, far: float = 0.3) -> Detection | None:
    """Return what is at a place that is by .05 nearer to nothing than to the one kind, which is `far` from it."""
    picture = np.full((450, 600), 150, np.uint8)
    ground = Ground(
        picture=picture.astype(np.float32), edges=find_edges(picture), plate_gray=plate_gray(picture), rectangles=frames
    )
    look = look_at(ground, PLACE)
    kinds = (
        TaughtKind(name="display", size_m=size_m, looks=look + far),
        TaughtKind(name=NOTHING, size_m=(0.01, 0.01), looks=look - far + 0.049),
    )
    found = chosen(ground, PLACE, look, Knowledge(kinds=kinds, spread=np.ones(LENGTH)), VIEW, PLATE_M)
    return next((one for one in found if one.reason is None), None)


def test_a_rectangle_of_its_size_outweighs_a_small_likeness_to_nothing() -> None:
    found = seen(frame(WIDE_M))
    assert found is not None and found.kind == "display" and found.confidence > 0.9
    assert found.distance == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param((), id="none"),
        pytest.param((frame((0.066, 0.060)),), id="of another height"),
        pytest.param((frame((0.030, 0.036)),), id="of another width"),
        pytest.param((frame(WIDE_M, coverage=0.6),), id="half of it without an edge"),
        pytest.param((frame(WIDE_M, off_px=3.0),), id="beside the place"),
    ],
)
def test_other_rectangles_do_not_count(frames: tuple[Rectangle, ...]) -> None:
    assert seen(*frames) is None


def test_a_rectangle_proves_nothing_for_a_kind_as_wide_as_high() -> None:
    assert seen(frame(ROUND_M), size_m=ROUND_M) is None


def test_what_is_unlike_everything_taught_is_not_surely_recognised_in_a_rectangle() -> None:
    unlike = seen(frame(WIDE_M), far=0.6)
    assert unlike is not None and unlike.confidence == pytest.approx(0.79)
    assert seen(frame(WIDE_M), far=0.81) is None


def test_the_rectangles_of_a_plate_are_found_where_they_are_drawn() -> None:
    picture = np.full((450, 600), 150, np.uint8)
    cv2.rectangle(picture, (250, 200), (349, 253), 40, -1)
    (found,) = lay_out(picture, VIEW, PLATE_M).rectangles
    assert (found.u, found.v) == pytest.approx((299.5, 226.5), abs=1.0)
    assert (found.width, found.height) == pytest.approx((99.0, 53.0), abs=2.0)
