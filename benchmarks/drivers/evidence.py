"""Pytest plugin that writes which driver each conformance test, and each test with third-party software, was about.

`pytest tests/drivers -p benchmarks.drivers.evidence --evidence OUT.json -m "conformance or third_party"`. The driver of
a conformance test is the one that its rig has connected; `third_party(package, *drivers)` marks the other tests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hal import registry
from hal.entry_points import load, registered
from hal.registry import DEVICES, Factory

CONNECTED = "connected"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--evidence`."""
    parser.addoption("--evidence", type=Path, help="file to write")


def pytest_configure(config: pytest.Config) -> None:
    """Note every driver that is looked up from now on, and collect reports where the results come together."""
    names = list[str]()
    look_up = registry.device_factory

    def noting(driver: str) -> Factory:
        names.append(driver)
        return look_up(driver)

    registry.device_factory = noting
    config.pluginmanager.register(_Noting(names))
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Writer(config.getoption("--evidence")))


class _Noting:
    """Adds the drivers that a test has connected, and its mark, to its report."""

    def __init__(self, names: list[str]) -> None:
        self._names = names

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        self._names.clear()
        yield
        mark = item.get_closest_marker("third_party")
        if mark is not None:
            item.user_properties.append((CONNECTED, {"package": mark.args[0], "drivers": list(mark.args[1:])}))
        elif item.get_closest_marker("conformance") is not None:
            drivers = list(dict.fromkeys(self._names)) or _by_class(item)
            item.user_properties.append((CONNECTED, {"package": None, "drivers": drivers}))


def _by_class(item: pytest.Item) -> list[str]:
    """Return the drivers whose entry point returns the class of the rig's device."""
    rig = getattr(item, "funcargs", {}).get("rig")
    if rig is None:
        return []
    made = {name: getattr(load(DEVICES, name, "driver"), "__annotations__", {}) for name in registered(DEVICES)}
    return [name for name, hints in made.items() if type(rig.device).__name__ in str(hints.get("return"))]


class _Writer:
    """Collects the results and writes them at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: list[dict[str, Any]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when != "call" and report.outcome == "passed":
            return
        about = dict(report.user_properties).get(CONNECTED)
        if about is not None:
            assert isinstance(about, dict)
            self._found.append({"test": report.nodeid, "outcome": report.outcome, **about})

    def pytest_sessionfinish(self) -> None:
        self._path.write_text(json.dumps(self._found))
