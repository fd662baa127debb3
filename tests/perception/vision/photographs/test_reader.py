"""Tests of the entry point for photographs: a reader per kind, refused requests, and real images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.vision_manometers import draw_manometer
from hal.errors import InvalidRequest
from perception.vision import decode, read_photograph
from perception.vision.warm import three_eights

REAL = Path(__file__).parents[4].parent / "shared" / "data" / "vision" / "real"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="the photographs are not beside the repository")


def test_a_drawn_gauge_is_read_in_its_own_scale() -> None:
    dial = draw_manometer(5)
    tenth = read_photograph(dial.image, "gauge", scale=(0.0, 10.0))
    thousand = read_photograph(dial.image, "gauge", scale=(0.0, 1000.0))
    assert tenth.value is not None and thousand.value is not None
    assert thousand.value == pytest.approx(100 * tenth.value)
    assert thousand.uncertainty == pytest.approx(100 * (tenth.uncertainty or 0.0))
    turned = read_photograph(dial.image, "gauge", scale=(0.0, 10.0), ends_rad=(2.356194, -2.356194))
    upright = read_photograph(dial.image, "gauge", scale=(0.0, 10.0), ends_rad=(-2.356194, 2.356194))
    assert turned.value is not None and turned.value + (upright.value or 0.0) == pytest.approx(10.0)


def test_a_display_is_read() -> None:
    assert read_photograph(three_eights(), "display", is_scene=True).text == "88.8"


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        ("dial", {}, "by its scale"),
        ("gauge", {"ends_rad": (-1.0, 1.0)}, "ends without a scale"),
        ("dial", {"scale": (1.0, 1.0)}, "cannot be"),
        ("gauge", {"scale": (0.0, np.inf)}, "cannot be"),
        ("gauge", {"scale": (10.0, 10.0)}, "cannot be"),
        ("display", {"pointer": "red"}, "no pointer"),
        ("gauge", {"scale": (0.0, 1.0), "ends_rad": (-135.0, 135.0)}, "rad cannot be"),
        ("gauge", {"scale": (0.0, 1.0), "ends_rad": (1.0, 1.0)}, "rad cannot be"),
        ("dial", {"scale": (0.0, 1.0), "ends_rad": (-1.0, 1.0)}, "full turn"),
        ("display", {"scale": (0.0, 1.0)}, "no scale"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_hint(kind: Any, given: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidRequest, match=words) as caught:
        read_photograph(three_eights(), kind, **given)
    assert caught.value.hint


@needs_real
def test_real_dials_and_a_real_gauge_are_read_within_their_labels() -> None:
    truth = json.loads((REAL / "truth.json").read_text())
    right = asked = 0
    for name, entry in truth.items():
        if entry["kind"] != "dial":
            continue
        kind: Any = "dial" if entry.get("circular", entry["set"] != "psi_gauge") else "gauge"
        span = entry["max"] - entry["min"]
        told = read_photograph(decode((REAL / name).read_bytes()), kind, scale=(entry["min"], entry["max"]))
        asked += 1
        if told.value is not None:
            off = abs(told.value - entry["reading"])
            right += min(off, span - off) <= 0.05 * span
    assert asked >= 15
    assert right >= asked - 1
