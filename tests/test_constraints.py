"""`constraints.txt` pins exactly the packages that `make setup` installs, at the installed versions."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import packages_distributions, requires, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
INSTALLED_EXTRAS = ("certify", "conform", "docs", "test")
INSTALLER = "uv"
ROOMS = ("drivers", "fusion", "hal", "manipulation", "perception", "service", "simbackend")
NOT_IMPORTED = {"tzdata"}  # the time zones of `zoneinfo` on systems that have none
FOR_OTHERS = {"bench", "docs", "test"}  # extras of what is not in the product


def _project() -> Any:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def _asked_for() -> list[str]:
    project = _project()
    extras = (project["optional-dependencies"][extra] for extra in INSTALLED_EXTRAS)
    return [INSTALLER, *project["dependencies"], *(line for extra in extras for line in extra)]


def _with_all_that_they_need(lines: Iterable[str]) -> set[str]:
    seen: set[tuple[str, str]] = set()
    waiting = [(Requirement(line), "") for line in lines]
    while waiting:
        requirement, for_extra = waiting.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": for_extra}):
            continue
        name = canonicalize_name(requirement.name)
        for extra in ("", *requirement.extras):
            if (name, extra) not in seen:
                seen.add((name, extra))
                waiting += [(Requirement(line), extra) for line in requires(name) or ()]
    return {name for name, _ in seen}


def _pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): pin for name, pin in pins}


def test_every_pin_is_installed_and_every_installed_package_is_pinned() -> None:
    pinned, needed = _pinned(), _with_all_that_they_need(_asked_for())
    assert sorted(needed - pinned.keys() - {"pip", "setuptools"}) == [], "not pinned"
    assert sorted(pinned.keys() - needed) == [], "pinned, but nothing needs it"


def test_the_installed_versions_are_the_pinned_ones() -> None:
    pinned = _pinned()
    assert {name: version(name) for name in pinned} == pinned


def test_every_pin_has_hashes_and_no_address_of_a_registry() -> None:
    text = (ROOT / "hashes.txt").read_text(encoding="utf-8")
    assert "//" not in text, "a registry's address belongs into the configuration of a machine"
    blocks = [block.split() for block in re.split(r"\n(?=\w)", text.split("\n", 1)[1].strip().replace("\\\n", ""))]
    hashed = {canonicalize_name(name): pin for name, _, pin in (words[0].partition("==") for words in blocks)}
    assert hashed == _pinned(), "`make hashes` writes hashes.txt anew"
    marks = [mark for _, *marks in blocks for mark in marks]
    assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", mark) for mark in marks)
    assert all(len(words) > 1 for words in blocks)


def _imported() -> Iterator[str]:
    """Yield the modules that the product's sources import, also by name with `import_module`."""
    for node in (
        n for room in ROOMS for path in (ROOT / room).rglob("*.py") for n in ast.walk(ast.parse(path.read_text()))
    ):
        match node:
            case ast.Import():
                yield from (alias.name for alias in node.names)
            case ast.ImportFrom(module=str(name), level=0):
                yield name
            case ast.Call(func=ast.Name(id="import_module"), args=[ast.Constant(value=str(name)), *_]):
                yield name


def test_the_product_declares_what_it_imports_and_nothing_else() -> None:
    project, installed = _project(), packages_distributions()
    modules = {name.partition(".")[0] for name in _imported()} - set(sys.stdlib_module_names) - set(ROOMS)
    assert not {module for module in modules if module not in installed}
    imported = {canonicalize_name(name) for module in modules for name in installed[module]}
    declared = {canonicalize_name(Requirement(line).name) for line in project["dependencies"]}
    optional = {
        canonicalize_name(Requirement(line).name)
        for extra, lines in project["optional-dependencies"].items()
        if extra not in FOR_OTHERS
        for line in lines
    }
    assert sorted(imported - declared - optional) == [], "imported, but not declared"
    assert sorted(declared - imported - NOT_IMPORTED) == [], "declared, but not imported"
    assert sorted(optional - imported) == [], "declared as an extra, but not imported"
