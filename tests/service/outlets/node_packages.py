"""Programs of npm that tests hold against ours: looked for in a folder that `.ci/run` fills, and never fetched by a test."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

NODE = shutil.which("node")
FOLDER = Path(__file__).parents[3] / ".venv" / "node"


def folder_of(package: str, version: str) -> Path:
    """Return the folder with `node_modules` in which a package is; skips the test where it is not installed."""
    if NODE is None:
        pytest.skip("Node.js is not installed (apt-get install nodejs)")
    found = FOLDER / "node_modules" / package / "package.json"
    if not found.exists():
        pytest.skip(f"{package} is not installed: npm install --prefix {FOLDER} {package}@{version}")
    assert json.loads(found.read_text())["name"] == package
    return FOLDER
