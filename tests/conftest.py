"""One setting for all: property tests try the same examples in every run, so that a red run is red again."""

from __future__ import annotations

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with long tests first: processes that share the files then end together."""
    long = {item.path for item in items if item.get_closest_marker("slow") or item.get_closest_marker("wire")}
    items.sort(key=lambda item: item.path not in long)
