"""One service with its console and one browser for all tests of the console."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.service.browser import browser
from tests.service.conftest import _write
from tests.service.console.served import Cell
from tests.service.waiting import eventually

__all__ = ["browser"]  # a fixture


@pytest.fixture(scope="package")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("console")
    cell = Cell(lambda **given: _write(folder, **given), tmp_path_factory.mktemp("runs"))
    yield cell
    cell.service.close()


@pytest.fixture(scope="module")
def page(browser: Any, cell: Cell) -> Iterator[Any]:
    tab = browser.new_page(viewport={"width": 1440, "height": 900})
    tab.set_default_timeout(60_000)
    faults: list[str] = []
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.goto(cell.url)
    yield tab
    assert faults == []


@pytest.fixture(autouse=True)
def nothing_runs(request: pytest.FixtureRequest) -> Iterator[None]:
    """End what a test has left running, because the next one would wait for it."""
    yield
    if "cell" in request.fixturenames:
        tasks = request.getfixturevalue("cell").service.service.tasks
        tasks.cancel_moving("its test has ended")
        eventually(lambda: tasks.moving() is None)
