"""Compares the paper's Table II with ours; `pytest -s` prints it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.fusion_simulation import TABLE_II, problem
from examples.paper.table2 import INCH_MM, PAPER, draw, errors, remark, robust, table
from fusion import fuse


def test_the_robust_pose_is_far_better_than_the_papers_from_the_fifth_measurement_on() -> None:
    made = problem(TABLE_II, np.random.default_rng(1), bad=[0])
    lines = table(made)
    print("\n".join(lines))
    assert len(lines) == 2 + len(PAPER)
    for n in (8, 12, 16):
        answer = robust(made, n)
        assert answer is not None
        assert [r.index for r in answer.rejected] == [0], "the first measurement is the bad one"
        ours_mm, ours_deg = errors(made.base_from_object, answer.pose)
        _, paper_inches, paper_deg = PAPER[n - 1]
        assert ours_mm < 0.1 * INCH_MM * paper_inches
        assert ours_deg < paper_deg


def test_the_example_says_why_it_has_no_pose() -> None:
    assert "refused" in remark(None)
    assert "free: turn about" in remark(fuse(problem(["1t"], np.random.default_rng(0)).measurements))


def test_figure_13_is_drawn(tmp_path: Path) -> None:
    draw(problem(TABLE_II, np.random.default_rng(1), bad=[0]), tmp_path)
    assert (tmp_path / "figure13.png").read_bytes().startswith(b"\x89PNG")
