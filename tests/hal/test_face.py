"""The public names of a package are loaded when they are first used."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

FACE = """
from typing import TYPE_CHECKING
from hal.face import load_on_first_use
if TYPE_CHECKING:
    from house import attic
    from house.cellar import LAMP as LIGHT
__all__ = ["LIGHT", "attic"]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
"""
ROOT = Path(__file__).parents[2]


def run(folder: Path, code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = [{str(folder)!r}, {str(ROOT)!r}]; {code}"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or done.stderr.strip().splitlines()[-1]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "house").mkdir()
    (tmp_path / "house" / "__init__.py").write_text(FACE)
    (tmp_path / "house" / "attic.py").write_text("TRUNK = 1")
    (tmp_path / "house" / "cellar.py").write_text("LAMP = 2")
    return tmp_path


def test_a_name_brings_its_module_along_and_no_other(folder: Path) -> None:
    loaded = "print([m for m in ('house.attic', 'house.cellar') if m in sys.modules])"
    assert run(folder, f"import house; {loaded}") == "[]"
    assert run(folder, f"from house import LIGHT; assert LIGHT == 2; {loaded}") == "['house.cellar']"


def test_a_module_of_the_package_may_be_a_name_of_its_face(folder: Path) -> None:
    assert run(folder, "import house; print(house.attic.TRUNK)") == "1"
    assert run(folder, "from house import attic; print(attic.TRUNK)") == "1"


def test_what_the_face_does_not_have_is_an_attribute_error(folder: Path) -> None:
    assert run(folder, "import house; house.roof") == "AttributeError: module 'house' has no attribute 'roof'"


FACES = sorted(
    file.parent
    for room in ("hal", "perception", "fusion", "manipulation", "simbackend", "drivers", "service")
    for file in (ROOT / room).rglob("__init__.py")
    if "load_on_first_use(" in file.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("face", FACES, ids=lambda face: str(face.relative_to(ROOT)))
def test_no_function_of_a_face_is_called_like_a_module_beside_it(face: Path) -> None:
    """Importing the module would put it in the function's place."""
    code = (face / "__init__.py").read_text(encoding="utf-8")
    taken = {path.stem for path in face.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    imports = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    package = ".".join(face.relative_to(ROOT).parts)
    names = {alias.asname or alias.name for node in imports if node.module != package for alias in node.names}
    assert not names & taken
