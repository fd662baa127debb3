"""The pictures of the console in the documentation show its pages as they are."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser

from benchmarks.console_served import Served, new_page
from hal.arrays import Array, Image
from tests.docs.console_pictures import PICTURES, PICTURES_OF_DOCS, SHOWN, after_a_week, taken
from tests.service.browser import NEEDS_CHROMIUM

pytestmark = [*NEEDS_CHROMIUM, pytest.mark.timeout(900)]
PIXELS_EACH_WAY = 8  # of which one remains: where things are counts, and not which digits they show
LEAST_ALIKE = (
    0.85  # .92 and more was found, .43 to .8 with the state of a page before a change, .56 at most with another page
)
DEPEND_ON_TODAY = ("rounds",)  # a calendar; only its size is compared


@pytest.fixture(scope="module")
def after_a_day() -> Iterator[tuple[Served, Browser]]:
    with after_a_week(days=1.0) as found:
        yield found


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize(("suffix", "width", "height", "scheme"), SHOWN)
def test_the_documentation_shows_this_page(
    after_a_day: tuple[Served, Browser], name: str, suffix: str, width: int, height: int, scheme: str
) -> None:
    service, browser = after_a_day
    page = taken(new_page(browser, width=width, height=height, scheme=scheme), service, name)
    shown = cv2.imread(str(PICTURES_OF_DOCS / f"{name}{suffix}.webp"), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == page.shape
    alike = float(np.mean(_layout(page) * _layout(np.asarray(shown, dtype=np.uint8))))
    renew = "look at the page; if it is as it should be, `make pictures` renews its picture"
    assert alike > LEAST_ALIKE or name in DEPEND_ON_TODAY, renew


def _layout(pixels: Image) -> Array:
    """Return a small gray picture with mean 0 and deviation 1."""
    height, width = pixels.shape[:2]
    small = (width // PIXELS_EACH_WAY, height // PIXELS_EACH_WAY)
    gray = cv2.resize(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), small, interpolation=cv2.INTER_AREA).astype(float)
    return np.asarray((gray - gray.mean()) / gray.std())
