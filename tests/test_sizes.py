"""Functions and files stay of a size that a reader can hold: a long one holds two reasons, which belong apart."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
ROOMS = (
    "hal", "drivers", "simbackend", "perception/calibration", "perception/range", "perception/vision", "fusion",
    "manipulation", "service", "benchmarks", "examples", "tests",
)  # fmt: skip
FUNCTION_LINES, PARAMETERS, FILE_LINES, MOST_FILE_LINES = 60, 10, 400, 300
MANY_PARAMETERS = ("compiled", "inlined", "command")  # kernels take plain arrays; a command has one for each option


def files_of(room: str) -> list[Path]:
    files = [file for file in (ROOT / room).rglob("*.py") if not {".venv", "build"} & set(file.parts)]
    assert files
    return files


@pytest.mark.parametrize("room", ROOMS)
def test_files_are_short(room: str) -> None:
    lines = {file: len(file.read_text(encoding="utf-8").splitlines()) for file in files_of(room)}
    assert [str(file.relative_to(ROOT)) for file, count in lines.items() if count > FILE_LINES] == []
    assert np.percentile(list(lines.values()), 95) <= MOST_FILE_LINES


@pytest.mark.parametrize("room", ROOMS)
def test_functions_are_short_and_take_few_parameters(room: str) -> None:
    too_large = []
    for file in files_of(room):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            given, made_by = node.args, " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
            parameters = len(given.posonlyargs + given.args + given.kwonlyargs)
            is_long = node.end_lineno is not None and node.end_lineno - node.lineno >= FUNCTION_LINES
            if is_long or (parameters > PARAMETERS and not any(word in made_by for word in MANY_PARAMETERS)):
                too_large.append(f"{file.relative_to(ROOT)}:{node.lineno} {node.name}")
    assert too_large == []


def test_the_operations_stay_few() -> None:
    """An operation joins a request, the faces of the wings and a typed result; mathematics belongs in a wing."""
    assert len(list((ROOT / "service/operations").glob("*.py"))) <= 15
