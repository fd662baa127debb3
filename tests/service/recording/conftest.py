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


@pytest.fixture
def recorded(write_cell: WriteCell, tmp_path: Path) -> RecordSession:
    """Return a function that records a session with some tasks, `recorded(inline=..., tasks=[(verb, request)])`."""

    def record(*, inline: bool = True, tasks: list[tuple[str, dict[str, Any]]], **given: Any) -> Path:
        path = tmp_path / "session.mcap"
        cell = load_cell(write_cell(robot=True, **given))
        with running(Service(cell, OPERATIONS, runs_dir=tmp_path / "runs", inline=inline, record=path)) as service:
            for verb, request in tasks:
                run(service, verb, **request)
        return path

    return record
