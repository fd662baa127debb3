"""Copies a cell file with all files that it names into a folder for editing."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from hal.config import load_cell
from hal.errors import ConfigError
from service.terminal import find_cell


@dataclass(frozen=True, slots=True, kw_only=True)
class CopiedCell:
    """The paths of the copies: the cell file, its panel file, and all files."""

    cell: Path
    panel: Path
    files: tuple[Path, ...]


def copy_cell(path: Path, folder: Path) -> CopiedCell:
    """Copy a cell file and the files that it names to the same relative paths below `folder`; all files or none.

    Args:
        path: a cell file, or the name of a shipped one.

    Raises:
        ConfigError: the cell is not valid or names a file by an absolute path, or a file exists in `folder` already.
    """
    source = find_cell(path)
    cell = load_cell(source)
    copies = {source: Path("cells") / source.name}
    settings = cell.file.cell
    panel = _relative(settings.panel, "cell.panel", source)
    copies[cell.panel_path] = panel
    calibrations = _relative(settings.calibrations, "cell.calibrations", source)
    for name in cell.calibrations:
        copies[cell.calibration_path(name)] = calibrations / f"{name}.toml"
    if settings.knowledge is not None and cell.knowledge_path is not None:
        knowledge = _relative(settings.knowledge, "cell.knowledge", source)
        for file in sorted(file for file in cell.knowledge_path.rglob("*") if file.is_file()):
            copies[file] = knowledge / file.relative_to(cell.knowledge_path)
    taken = [folder / target for target in copies.values() if (folder / target).exists()]
    if taken:
        raise ConfigError(
            f"{taken[0]} exists already; nothing was written", hint="give another folder, or move it away"
        )
    for file, target in copies.items():
        (folder / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folder / target)
    return CopiedCell(
        cell=folder / copies[source], panel=folder / panel, files=tuple(folder / target for target in copies.values())
    )


def _relative(text: str, key: str, cell_path: Path) -> Path:
    """Return a path from the cell file, which must be relative so that it also leads to the copy."""
    path = Path(text)
    if path.is_absolute() or ".." in path.parts:
        raise ConfigError(
            f"{cell_path}: {key}: {text!r} would lead the copy outside of its folder",
            hint="give a path relative to the cell file's folder or one above it",
            file=str(cell_path),
            key=key,
        )
    return path
