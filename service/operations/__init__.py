"""The verbs of the cell, by name."""

from __future__ import annotations

from service.operations.context import CellMemory, Operation, OperationContext

OPERATIONS: dict[str, Operation] = {}

__all__ = ["OPERATIONS", "CellMemory", "Operation", "OperationContext"]
