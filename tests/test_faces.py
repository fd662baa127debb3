"""The packages' public names are few, exist, are used, hide no module, and are known to type checkers."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
FACES = (
    "fusion",
    "manipulation",
    "perception.calibration",
    "perception.range",
    "perception.vision",
    "perception.vision.teaching",
)
HEAVY = {"cv2", "numba", "numpy", "pydantic", "scipy"}
IMPORT = re.compile(r"from ([\w.]+) import (\([^)]*\)|[^\n]*)")


def _used() -> Iterator[str]:
    """Yield the names that users import from packages, as `package.name`, including access by a dot."""
    for folder, ending in (("service", "py"), ("examples", "py"), ("docs", "md")):
        for path in (ROOT / folder).rglob(f"*.{ending}"):
            text = path.read_text(encoding="utf-8")
            for module, names in IMPORT.findall(text):
                yield from (f"{module}.{name}" for name in re.findall(r"\w+", names))
            yield from re.findall(r"\b[\w.]*\w\.\w+", text)


USED = frozenset(_used())


@pytest.fixture(params=FACES)
def face(request: pytest.FixtureRequest) -> ModuleType:
    return import_module(request.param)


def test_a_face_has_at_most_forty_names_and_each_loads(face: ModuleType) -> None:
    assert 0 < len(face.__all__) <= 40
    assert all(getattr(face, name) is not None for name in face.__all__)


def test_no_name_of_a_face_hides_a_module(face: ModuleType) -> None:
    folder = Path(str(face.__file__)).parent
    modules = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    hidden = [name for name in modules & set(face.__all__) if not isinstance(getattr(face, name), ModuleType)]
    assert not hidden


def test_each_name_of_a_face_has_a_user(face: ModuleType) -> None:
    full, last = face.__name__, face.__name__.rpartition(".")[2]
    unused = [name for name in face.__all__ if not {f"{full}.{name}", f"{last}.{name}"} & USED]
    assert not unused


@pytest.mark.parametrize("name", FACES)
def test_importing_a_face_imports_nothing_heavy(name: str) -> None:
    code = f"import sys; import {name}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert name in loaded
    assert not HEAVY & set(loaded)


def test_type_checkers_refuse_a_name_that_a_face_does_not_have(tmp_path: Path) -> None:
    lines = [
        f"from {name} import {word}" for name in FACES for word in (import_module(name).__all__[0], "no_such_name")
    ]
    (tmp_path / "user.py").write_text("\n".join(lines))
    command = [sys.executable, "-m", "mypy", str(tmp_path / "user.py")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    refused = re.findall(r'Module "([\w.]+)" has no attribute "(\w+)"', done.stdout)
    assert sorted(refused) == [(name, "no_such_name") for name in FACES]
