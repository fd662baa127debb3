"""Settings of all tests: property tests try the same examples in every run, so that failures are reproducible."""

from __future__ import annotations

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.register_profile(  # for the figures: 100 000 steps of each model; see tests/service/http/test_life_cycle.py
    "long", deadline=None, print_blob=True, max_examples=2000, stateful_step_count=50
)
settings.register_profile("seeded", deadline=None, print_blob=True, max_examples=50)  # for benchmarks.faults
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run files with long tests first, so that processes that share the files end at about the same time."""
    long = {item.path for item in items if item.get_closest_marker("slow") or item.get_closest_marker("wire")}
    items.sort(key=lambda item: item.path not in long)
