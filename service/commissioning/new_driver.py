"""Writes the files of a new driver from templates of the entry-point group `panelwright.scaffold`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from hal.devices import DeviceKind
from hal.errors import REINSTALL, ConfigError

SHORT = {"scanner": DeviceKind.RANGE_SCANNER, "ft": DeviceKind.FORCE_TORQUE, "force": DeviceKind.FORCE_TORQUE}


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """The files that were written and changed, and the commands that run the tests and install the driver."""

    files: tuple[Path, ...]
    registered: tuple[Path, ...]
    try_it: str
    install: str


def parse_kind(what: str) -> tuple[DeviceKind, str]:
    """Split text such as `scanner:foo` into kind and name.

    Raises:
        ConfigError: the text does not have that form, or there is no such kind.
    """
    word, _, name = what.partition(":")
    kinds = [*DeviceKind, *SHORT]
    if not name:
        raise ConfigError(f"{what!r} names no driver", hint="KIND:NAME, for example scanner:foo")
    if word not in kinds:
        raise ConfigError(f"there is no kind {word!r}", hint=f"kinds: {', '.join(kinds)}")
    return SHORT.get(word) or DeviceKind(word), name


def write_driver(kind: DeviceKind, name: str, *, transport: str, folder: Path, package: str | None) -> Written:
    """Write all files of a new driver, or none.

    Args:
        folder: panelwright's own tree, whose `pyproject.toml` then gets the entry points, or any other folder, which
            becomes a separate package.

    Raises:
        ConfigError: name, kind or transport is not possible, a file exists, or there are no templates.
    """
    templates = _templates()
    is_tree = package is None and (folder / "drivers" / "emulators").is_dir()
    own = None if is_tree else package or f"panelwright_{name}"
    files = templates.new_driver(name, kind, transport=transport, package=own)
    taken = [path for path in files if (folder / path).exists()]
    if taken:
        raise ConfigError(f"{folder / taken[0]} exists already", hint="choose another name; nothing was written")
    project, registered = folder / "pyproject.toml", ""
    if is_tree:
        lines = templates.entry_points(name, transport)
        registered = with_lines(project.read_text(encoding="utf-8"), lines, project)
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    if is_tree:
        project.write_text(registered, encoding="utf-8")
    tests = next(path for path in files if path.name.startswith("test_"))
    return Written(
        files=tuple(folder / path for path in files),
        registered=(project,) if is_tree else (),
        try_it=f"cd {folder} && python -m pytest {tests}",
        install=f"pip install --no-deps -e {folder}",
    )


def with_lines(text: str, lines: dict[str, str], path: Path) -> str:
    """Return the TOML `text` with each line inserted at the top of its table.

    Raises:
        ConfigError: there is no such table.
    """
    for header, line in lines.items():
        if f"{header}\n" not in text:
            raise ConfigError(f"{path} has no table {header}", hint="put the entry points there by hand")
        text = text.replace(f"{header}\n", f"{header}\n{line}\n", 1)
    return text


def _templates() -> ModuleType:
    points = list(entry_points(group="panelwright.scaffold"))
    if not points:
        raise ConfigError("no installed package has templates of drivers", hint=REINSTALL)
    module: ModuleType = points[0].load()
    return module
