"""The faces of vision and calibration: few names, each there and used, none that hides a module."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
USERS = [
    path.read_text(encoding="utf-8")
    for folder, ending in (("service", "py"), ("examples", "py"), ("docs", "md"))
    for path in (ROOT / folder).rglob(f"*.{ending}")
]


@pytest.fixture(params=["perception.vision", "perception.vision.teaching", "perception.calibration"])
def face(request: pytest.FixtureRequest) -> ModuleType:
    return import_module(request.param)


def test_a_face_has_at_most_forty_names_and_each_loads(face: ModuleType) -> None:
    assert 0 < len(face.__all__) <= 40
    assert all(getattr(face, name) is not None for name in face.__all__)


def test_no_name_of_a_face_hides_a_module(face: ModuleType) -> None:
    folder = Path(str(face.__file__)).parent
    modules = {path.stem for path in folder.glob("*.py")} | {path.name for path in folder.iterdir() if path.is_dir()}
    assert not modules & set(face.__all__)


def test_each_name_of_a_face_has_a_user(face: ModuleType) -> None:
    texts = [text for text in USERS if face.__name__ in text]
    unused = [name for name in face.__all__ if not any(re.search(rf"\b{name}\b", text) for text in texts)]
    assert not unused
