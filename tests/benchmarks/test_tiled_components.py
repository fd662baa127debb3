"""The components equal those of scipy for any number of tiles."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from benchmarks.tiled_components import label_components, merge_rounds
from perception.range.tiles import tile_rows


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.floats(0.2, 0.9))
def test_labels_match_scipy_and_do_not_depend_on_tiles(seed, density):
    mask = np.random.default_rng(seed).random((37, 23)) < density
    linked = np.ones_like(mask)
    labels, sizes = label_components(mask, linked, linked)
    expected, count = ndimage.label(mask)
    assert sizes.size == count + 1
    np.testing.assert_array_equal(labels, expected)
    for tiles in (2, 3, 8, 32, 100):
        np.testing.assert_array_equal(label_components(mask, linked, linked, tiles=tiles)[0], labels)


def test_links_cut_components():
    mask = np.ones((4, 6), bool)
    right = np.ones_like(mask)
    right[:, 2] = False
    labels, sizes = label_components(mask, right, np.ones_like(mask), tiles=2)
    assert labels.max() == 2 and list(sizes[1:]) == [12, 12]


def test_seams_merge_in_log_rounds():
    seams = [top for top, _ in tile_rows(320, 32)][1:]
    rounds = merge_rounds(seams)
    assert len(rounds) == 5
    assert sorted(s for r in rounds for s in r) == seams
