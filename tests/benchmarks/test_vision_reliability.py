"""The reliability diagram distinguishes correct confidences from wrong ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.vision_reliability import Answer, draw_reliability, reliability, reliability_lines


def answers_with(confidences: np.ndarray, right: np.ndarray) -> list[Answer]:
    return [Answer(confidence=float(c), right=bool(r)) for c, r in zip(confidences, right, strict=True)]


def test_honest_confidences_lie_on_the_diagonal() -> None:
    rng = np.random.default_rng(0)
    c = rng.uniform(0.5, 1.0, 20_000)
    bins, error = reliability(answers_with(c, rng.uniform(size=c.size) < c))
    assert error < 0.015
    assert all(abs(b.confidence - b.right) < 4 * b.sigma + 1e-3 for b in bins)
    assert sum(b.count for b in bins) == c.size


def test_a_reader_that_is_half_right_at_full_confidence_is_caught() -> None:
    bins, error = reliability(answers_with(np.full(100, 0.99), np.arange(100) % 2 == 0))
    assert error == pytest.approx(0.49)
    assert bins[-1].right == 0.5


def test_one_answer_is_no_certainty() -> None:
    (only,), _ = reliability([Answer(confidence=0.99, right=True)])
    assert only.right == 1.0
    assert only.sigma > 0.2


def test_the_diagram_is_written_and_shows_every_count(tmp_path: Path) -> None:
    answers = answers_with(np.linspace(0.5, 1.0, 50), np.arange(50) % 5 > 0)
    draw_reliability(answers, tmp_path / "out" / "diagram.png")
    picture = cv2.imread(str(tmp_path / "out" / "diagram.png"))
    assert picture is not None
    assert (picture < 200).any()
    assert len(reliability_lines("x", answers)) == 1 + len(reliability(answers)[0])
