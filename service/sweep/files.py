"""Writes the files of a random panel."""

from __future__ import annotations

import tomllib
from pathlib import Path

import tomlkit

from hal.config import load_cell
from service.sweep.draw import draw_panel


def write_files(seed: int, base: Path, folder: Path) -> Path:
    """Write the panel as stated, the panel as built and the cell into a folder; returns the path of the cell file."""
    drawn, loaded = draw_panel(seed), load_cell(base)
    for name, table in (("panel", drawn.stated), ("built", drawn.built)):
        (folder / f"{name}.toml").write_text(tomlkit.dumps(table), encoding="utf-8")
    table = tomllib.loads(base.read_text(encoding="utf-8"))
    table["cell"] |= {
        "panel": str((folder / "panel.toml").resolve()),
        "calibrations": str(loaded.calibration_path("any").parent.resolve()),
    }
    if loaded.knowledge_path is not None:
        table["cell"]["knowledge"] = str(loaded.knowledge_path.resolve())
    built = {"built_panel": str((folder / "built.toml").resolve())}
    table["simulation"] = {**table.get("simulation", {}), **drawn.simulation, **built}
    path = folder / "cell.toml"
    path.write_text(tomlkit.dumps(table), encoding="utf-8")
    return path
