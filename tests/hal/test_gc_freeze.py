"""Full garbage collections skip frozen objects and still find later cycles."""

from __future__ import annotations

import gc
import weakref

import pytest

from hal.gc_freeze import freeze_loaded


class Link:
    """Object of which two make a reference cycle."""

    other: Link | None = None


@pytest.fixture(autouse=True)
def thawed() -> object:
    """Restore the collector of the test process afterwards."""
    yield
    gc.unfreeze()


def test_a_full_collection_does_not_walk_what_was_frozen() -> None:
    kept = [Link() for _ in range(1000)]
    assert len(gc.get_objects()) > len(kept)
    freeze_loaded()
    assert gc.get_freeze_count() > len(kept)
    assert len(gc.get_objects()) < len(kept)


def test_cycles_made_afterwards_are_still_collected() -> None:
    freeze_loaded()
    a, b = Link(), Link()
    a.other, b.other = b, a
    gone = weakref.ref(a)
    del a, b
    gc.collect()
    assert gone() is None
