"""Recordings of the cell of fakes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hal.config import load_cell
from service.core import Service
from tests.service.conftest import WriteCell
from tests.service.recording.looks import OPERATIONS

RecordSession = Callable[..., Path]


@contextmanager
def running(service: Service) -> Iterator[Service]:
    """Start a service and close it at the end."""
    try:
        service.start()
        yield service
    finally:
        service.close()


def run(service: Service, verb: str, **request: Any) -> Any:
    """Run a task to its end and return it."""
    task = service.submit(verb, OPERATIONS[verb].request_model.model_validate(request))
    assert task.wait(60.0)
    return task


@pytest.fixture(scope="module")
def looked(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of one task that looks twice, for all tests of a module."""
    path = tmp_path_factory.mktemp("recording") / "session.mcap"
    cell = load_cell(write_module_cell(robot=True))
    with running(Service(cell, OPERATIONS, runs_dir=path.parent / "runs", inline=True, record=path)) as service:
        run(service, "look", looks=2)
    return path


@pytest.fixture
def recorded(write_cell: WriteCell, tmp_path: Path) -> RecordSession:
    """Return a function that records a session with some tasks, `recorded(inline=..., tasks=[(verb, request)])`."""

    def record(*, inline: bool = True, tasks: list[tuple[str, dict[str, Any]]], **given: Any) -> Path:
        path = tmp_path / "session.mcap"
        cell = load_cell(write_cell(robot=True, **given))
        with running(Service(cell, OPERATIONS, runs_dir=tmp_path / "runs", inline=inline, record=path)) as service:
            service.supervisor.reset("a person", seen_count=service.supervisor.latch.state().count)
            for verb, request in tasks:
                run(service, verb, **request)
        return path

    return record
