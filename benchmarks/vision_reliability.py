"""Reliability of confidences: the fraction of right readings by confidence, as a table and a diagram."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

EDGES = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0001)
SIDE_PX, MARGIN_PX = 420, 50
INK, GRID, BAR = (40, 40, 40), (215, 215, 215), (170, 120, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Answered reading: its confidence, and whether it is right (state or text exact, value within 2 % of scale)."""

    confidence: float
    right: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Bin:
    """Answers between two confidences: count, mean confidence, and fraction right with its standard deviation."""

    low: float
    high: float
    count: int
    confidence: float
    right: float
    sigma: float


def reliability(answers: Sequence[Answer], edges: Sequence[float] = EDGES) -> tuple[list[Bin], float]:
    """Return the non-empty bins and the expected calibration error, the mean |confidence - fraction right|.

    The standard deviation is Wilson's (JASA 22, 1927), so that it is not zero for a bin with one answer.
    """
    c = np.array([a.confidence for a in answers])
    right = np.array([a.right for a in answers], float)
    bins, lie = [], 0.0
    for low, high in pairwise(edges):
        inside = (c >= low) & (c < high)
        n = int(inside.sum())
        if n == 0:
            continue
        share, mean = float(right[inside].mean()), float(c[inside].mean())
        sigma = float(np.sqrt(share * (1 - share) / n + 0.25 / n**2) / (1 + 1 / n))
        bins.append(Bin(low=low, high=min(high, 1.0), count=n, confidence=mean, right=share, sigma=sigma))
        lie += n * abs(mean - share)
    return bins, lie / max(1, len(answers))


def reliability_lines(what: str, answers: Sequence[Answer]) -> list[str]:
    """Return the diagram as text, one line per bin."""
    bins, error = reliability(answers)
    lines = [f"\nreliability of confidences, {what}: {len(answers)} answers, expected calibration error {error:.3f}"]
    lines += [
        f"  {b.low:.2f} to {b.high:.2f}: {b.count:5d} answers, mean confidence {b.confidence:.3f},"
        f" right {b.right:.3f} +- {b.sigma:.3f}"
        for b in bins
    ]
    return lines


def draw_reliability(answers: Sequence[Answer], path: Path) -> None:
    """Write the diagram as PNG: a bar per bin, its sigma and count, and the diagonal of correct confidences."""
    size = SIDE_PX + 2 * MARGIN_PX
    picture = np.full((size, size, 3), 255, np.uint8)
    for tick in np.linspace(0.5, 1.0, 6):
        (x, y), (x1, y0) = _at(float(tick), float(tick)), _at(1.0, 0.0)
        cv2.line(picture, (MARGIN_PX, y), (x1, y), GRID, 1)
        cv2.line(picture, (x, _at(0, 1.0)[1]), (x, y0), GRID, 1)
        _write(picture, f"{tick:.1f}", (x - 12, size - 20))
    for tick in np.linspace(0.0, 1.0, 6):
        _write(picture, f"{tick:.1f}", (12, _at(0.5, float(tick))[1] + 4))
    cv2.line(picture, _at(0.5, 0.5), _at(1.0, 1.0), INK, 1, cv2.LINE_AA)
    bins, _ = reliability(answers)
    for b in bins:
        cv2.rectangle(picture, _at(b.low, b.right), _at(b.high, 0.0), BAR, 1)
        x = _at(b.confidence, 0.0)[0]
        cv2.circle(picture, (x, _at(0, b.right)[1]), 4, BAR, -1, cv2.LINE_AA)
        cv2.line(picture, _at(b.confidence, b.right - b.sigma), _at(b.confidence, min(1.0, b.right + b.sigma)), BAR, 1)
        _write(picture, str(b.count), (x - 10, _at(0, b.right)[1] - 8))
    _write(picture, "share right over confidence, counts", (MARGIN_PX, 20))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture)


def _at(confidence: float, right: float) -> tuple[int, int]:
    x = MARGIN_PX + SIDE_PX * (confidence - 0.5) / 0.5
    return round(x), round(MARGIN_PX + SIDE_PX * (1.0 - right))


def _write(picture: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, INK, 1, cv2.LINE_AA)
