"""Condensing leaves out the taught looks that the kept ones recognise with a margin."""

from __future__ import annotations

import numpy as np

from perception.vision.teaching.condense import OBJECT_MARGIN, worth_keeping


def test_equal_looks_are_kept_once() -> None:
    looks = np.repeat([[0.0, 0.0], [2.0, 2.0]], 20, axis=0)
    names = np.repeat(["lamp", "lever"], 20)
    assert len(worth_keeping(looks, names, np.ones(2), weights=np.ones(2))) == 2


def test_every_look_is_told_by_the_kept_ones() -> None:
    random = np.random.default_rng(4)
    looks = np.concatenate([random.normal(0.0, 0.6, (80, 6)), random.normal(1.2, 0.6, (80, 6))])
    names = np.repeat(["lamp", "lever"], 80)
    kept = worth_keeping(looks, names, np.ones(6), weights=np.ones(6))
    assert 2 <= len(kept) < len(looks)
    distance = np.minimum(np.abs(looks[:, None] - looks[None, kept]), 3.0).mean(axis=2)
    same = names[:, None] == names[None, kept]
    own = np.where(same, distance, np.inf).min(axis=1)
    other = np.where(same, np.inf, distance).min(axis=1)
    assert ((own <= other - OBJECT_MARGIN) | (own == 0.0)).all()
