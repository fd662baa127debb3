"""Gathers for a report who asked for the mission, with what it was done, and what the objects showed before."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from hal.config import Cell


def origin_of(cell: Cell, *, asked_by: str, newest: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the fields of `report.json` that are known before the mission.

    Args:
        newest: fields of the newest reading of each object so far, by its name.
    """
    mounted = (cell.calibration_of(name) for name, one in cell.file.devices.items() if one.mount is not None)
    return {
        "version": version("panelwright"),
        "asked_by": asked_by,
        "labels": {one.name: one.label for one in cell.panel.objects if one.label},
        "previous": {name: _earlier(reading) for name, reading in newest.items()},
        "calibrations": [{"device": one.device, "date": one.date, "method": one.method} for one in mounted],
    }


def _earlier(reading: Mapping[str, Any]) -> dict[str, Any]:
    kept = {key: reading[key] for key in ("value", "unit", "state", "text", "utc_s")}
    return {**kept, "uncertainty": reading["sigma"]}
