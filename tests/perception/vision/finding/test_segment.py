"""Compares region growing and its sums with plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from perception.vision.finding.segment import grow_regions


def scene() -> np.ndarray:
    image = np.full((60, 80), 100, np.uint8)
    image[10:30, 15:40] = 180
    image[35:50, 50:70] = 40
    return image


def test_flat_areas_become_one_region_each() -> None:
    regions = grow_regions(scene())
    assert len(regions.area_px) == 3
    assert sorted(regions.area_px) == [300, 500, 4000]
    bright = int(np.argmax(regions.mean))
    assert regions.box_px[bright].tolist() == [15, 10, 25, 20]
    assert np.allclose(regions.middle_px[bright], [27.0, 19.5])


def test_sums_agree_with_the_labels() -> None:
    rng = np.random.default_rng(5)
    image = np.clip(scene() + rng.normal(0, 4, (60, 80)), 0, 255).astype(np.uint8)
    regions = grow_regions(image)
    for k in range(len(regions.area_px)):
        inside = regions.labels == k
        v, u = np.nonzero(inside)
        assert inside.sum() == regions.area_px[k]
        assert np.isclose(image[inside].astype(float).mean(), regions.mean[k])
        assert np.isclose(image[inside].astype(float).var(), regions.variance[k], atol=1e-6)
        assert regions.box_px[k].tolist() == [u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1]


@pytest.mark.parametrize("sigma", [2.0, 5.0, 8.0])
def test_noise_leaves_the_large_regions_whole_and_few_single_pixels(sigma: float) -> None:
    noisy = scene() + np.random.default_rng(6).normal(0, sigma, (60, 80))
    image = np.clip(noisy, 0, 255).astype(np.uint8)
    regions = grow_regions(image)
    assert (regions.labels == grow_regions(image.copy()).labels).all()
    assert sorted(regions.area_px)[-3:] == pytest.approx([300, 500, 4000], rel=0.03)
    assert len(regions.area_px) < 30, "a tolerance that knows no noise leaves hundreds at the larger ones"


def test_a_ring_that_closes_late_is_one_region() -> None:
    image = np.full((40, 40), 30, np.uint8)
    image[5:35, 5:35] = 200
    image[12:28, 12:28] = 30
    regions = grow_regions(image)
    assert sorted(regions.area_px) == sorted([900 - 256, 256, 1600 - 900])


def test_a_single_pixel_and_more_regions_than_planned() -> None:
    assert len(grow_regions(np.array([[7]], np.uint8)).area_px) == 1
    checker = (np.indices((50, 50)).sum(axis=0) % 2 * 200).astype(np.uint8)
    assert grow_regions(checker).area_px.sum() == 2500
