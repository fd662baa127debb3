"""The lines for best guesses state the fractions right beside the expected ones."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.vision import main
from benchmarks.vision_report import LEVELS, guess_lines


def row(
    *, error: float, confidence: float, cls: str = "display", level: str = "hard", answered: bool = True
) -> dict[str, Any]:
    return {"cls": cls, "level": level, "answered": answered, "error": error, "confidence": confidence}


def everything_right(confidence: float) -> list[dict[str, Any]]:
    kinds = ("display", "gauge", "toggle", "slider")
    return [row(error=0.0, confidence=confidence, cls=cls, level=level) for cls in kinds for level in LEVELS]


def line(lines: list[str], what: str) -> tuple[list[float], list[float]]:
    """Return the figures of a line before and after the word `expected`."""
    found = next(text for text in lines if what in text).split(what)[1]
    right, expected = (part.replace("/", " ").split() for part in found.split("expected"))
    return [float(value) for value in right], [float(value) for value in expected]


def test_luck_shows_as_the_gap_between_right_and_expected() -> None:
    assert line(guess_lines(everything_right(0.25)), "displays exact") == ([1.0] * 3, [0.25] * 3)


def test_what_is_refused_nevertheless_is_wrong_and_expects_nothing() -> None:
    rows = [*everything_right(1.0), row(error=100.0, confidence=0.9, answered=False)]
    right, expected = line(guess_lines(rows), "displays exact")
    assert (right[-1], expected[-1]) == (0.5, 0.5)


def test_the_least_sure_are_refused_first_whatever_their_kind() -> None:
    rows = [*everything_right(0.9) * 8, *[row(error=100.0, confidence=0.1)] * 5]  # 101 rows, of which 5 % are 5
    assert line(guess_lines(rows), "are refused") == ([0.0], [pytest.approx(0.1)])
    rows += [row(error=100.0, confidence=0.1, cls="gauge")]
    assert line(guess_lines(rows), "are refused")[0] == [pytest.approx(1 / 97, abs=1e-3)]


@pytest.mark.parametrize("arguments", [["in.json"], ["in.json", "out.json", "--least-confidence", "1.5"]])
def test_the_runner_says_how_it_is_called(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert "--least-confidence" in capsys.readouterr().out
