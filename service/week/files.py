"""Writes the plant of the week: a copy of a cell with limits in its panel file, a mission with a condition, and a round."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from hal.config import load_cell
from hal.errors import ConfigError
from hal.panel import Panel
from service.commissioning.new_cell import copy_cell

PRESSURE, FLOW, CURRENT, TEMPERATURE, LAMP, VALVE = (
    "pressure",
    "flow",
    "current",
    "temperature",
    "run_lamp",
    "main_valve",
)
READ = (PRESSURE, FLOW, CURRENT, TEMPERATURE, LAMP)
HIGH_BAR, TOO_HIGH_BAR, ZONE = 6.0, 7.0, "UTC"
LIMITS: dict[str, dict[str, Any]] = {
    PRESSURE: {
        "limits": {"low": 1.0, "high": HIGH_BAR, "high_high": 9.0, "deadband": 0.2},
        "stale_after_s": 86_400.0,
        "priority": "high",
        "what_to_do": "look whether the main valve is closed",
    },
    TEMPERATURE: {"limits": {"high": 60.0, "high_high": 80.0, "deadband": 1.0}, "what_to_do": "check the cooling"},
    LAMP: {"normal": ["on"], "priority": "low", "what_to_do": "ask the shift leader whether the plant was shut down"},
}
ROUND: dict[str, Any] = {"name": "patrol", "mission": "patrol", "cron": "0 */6 * * *", "zone": ZONE}
MISSION = f"""# Reads the instruments every six hours, and closes the main valve when the pressure is too high.
schema = 1
title = "Patrol: read the instruments, relieve the pressure if it is too high"

[[steps]]
kind = "inspect"
name = "read"
objects = [{", ".join(f'"{name}"' for name in READ)}]

# Looks again before anything is touched. If the interval of the value straddles the limit, or the gauge cannot be read, the
# answer is unknown, and the valve is not touched.
[[steps]]
kind = "choose"
name = "decide"
on_failure = "skip"
when = [{{ object = "{PRESSURE}", above = {TOO_HIGH_BAR}, unit = "bar" }}]

[[steps.then]]
kind = "set"
name = "relieve"
object = "{VALVE}"
state = "closed"
"""


def write_plant(cell: Path, folder: Path, *, seed: int | None = None) -> Path:
    """Copy a simulated cell with all its files into a folder, and add limits, mission and round; returns the cell file.

    Args:
        seed: takes the place of the one in the cell file.

    Raises:
        ConfigError: the cell is not simulated or has not the objects of the week, or a file exists in the folder already.
    """
    loaded = load_cell(cell)
    if loaded.file.cell.mode != "sim":
        raise ConfigError(
            f"{cell}: a week passes in minutes only on a simulated cell, and mode is {loaded.file.cell.mode!r}",
            hint='leave --cell out, or name a cell with mode = "sim"',
        )
    _check_objects(loaded.panel, cell)
    copied = copy_cell(cell, folder)
    _edit_panel(copied.panel)
    document = tomlkit.parse(copied.cell.read_text(encoding="utf-8"))
    rounds = tomlkit.aot()
    rounds.append(tomlkit.item(ROUND))
    document["rounds"] = rounds
    if seed is not None:
        document["cell"]["seed"] = seed
    copied.cell.write_text(tomlkit.dumps(document), encoding="utf-8")
    mission = folder / "missions" / f"{ROUND['mission']}.toml"
    mission.parent.mkdir(exist_ok=True)
    mission.write_text(MISSION, encoding="utf-8")
    return copied.cell


def keep_shown(cell: Path, shows: Mapping[str, float]) -> None:
    """Write into the cell file what the instruments show at the end, so that a later service begins there."""
    document = tomlkit.parse(cell.read_text(encoding="utf-8"))
    table = tomlkit.inline_table()
    table.update({name: round(value, 3) for name, value in shows.items()})
    simulation = document.setdefault("simulation", tomlkit.table())
    simulation["shows"] = table
    cell.write_text(tomlkit.dumps(document), encoding="utf-8")


def _check_objects(panel: Panel, cell: Path) -> None:
    names = {one.name for one in panel.objects}
    missing = [name for name in (*READ, VALVE) if name not in names]
    if missing:
        raise ConfigError(
            f"{cell}: panel {panel.name!r} has no {', '.join(missing)}, which the week needs",
            hint="leave --cell out: the bench cell has them",
        )


def _edit_panel(path: Path) -> None:
    """Write the limits into a panel file, at the objects that they belong to."""
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    for entry in document["objects"]:
        for key, value in LIMITS.get(str(entry["name"]), {}).items():
            item = tomlkit.inline_table() if isinstance(value, dict) else value
            if isinstance(value, dict):
                item.update(value)
            entry[key] = item
    path.write_text(tomlkit.dumps(document), encoding="utf-8")
