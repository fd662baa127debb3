"""The example of Table II says in words what it could not answer."""

from __future__ import annotations

import numpy as np

from examples.table2 import remark
from fusion import fuse
from fusion.simulate import problem


def test_the_example_says_why_it_has_no_pose() -> None:
    assert "refused" in remark(None)
    assert "free: turn about" in remark(fuse(problem(["1t"], np.random.default_rng(0)).measurements))
