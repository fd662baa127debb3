"""What an operation gets beside its request: the cell, its task, a folder, and what the cell has found out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from hal.config import Cell
from service.operations.world_model import WorldModel
from service.processes.connection import CellConnection
from service.tasks.store import TaskContext


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OperationContext:
    """Handed to every operation. `runs_dir` is where missions leave their reports."""

    connection: CellConnection
    task: TaskContext
    runs_dir: Path
    world: WorldModel = field(default_factory=WorldModel)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Operation:
    """A verb of the API.

    Attributes:
        name: path of the verb, e.g. `panel-pose`.
        request_model: strict model of the body.
        result_model: what a task of this verb ends with.
        run: does the work in a worker thread; returns a `result_model`; raises `CellError`.
        summary: one line for the API document.
        example: a body that works on the shipped cell.
        moves: whether it may move the arm (needs the lease when one is held, and excludes other motion tasks).
        is_still: tells of requests for which it does not, although it may.
        check: raises `InvalidRequest` for a request that makes no sense in this cell, before there is a task.
    """

    name: str
    request_model: type[BaseModel]
    result_model: type[BaseModel]
    run: Callable[[OperationContext, Any], BaseModel]
    summary: str
    example: dict[str, Any] = field(default_factory=dict)
    moves: bool = True
    is_still: Callable[[Any], bool] = field(default=lambda _request: False)
    check: Callable[[Cell, Any], None] = field(default=lambda _cell, _request: None)

    def may_move(self, request: BaseModel) -> bool:
        """May the arm move for this request?"""
        return self.moves and not self.is_still(request)
