"""The file references in docs/ name every key of the models."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from hal import panel
from hal.calibration import CalibrationRecord, IntrinsicsRecord, LoadRecord, MountRecord
from hal.config import CellSection, DeviceSection, EmulatorSection, SafetySection, WorkspaceSection

DOCS = Path(__file__).parents[2] / "docs" / "reference"
PANEL_MODELS = (
    panel.Panel, panel.Light, panel.Scale, panel.State, panel.Tolerances, panel.Gauge, panel.PanelMeter, panel.Display,
    panel.Lamp, panel.Button, panel.Toggle, panel.Rotary, panel.Slider, panel.Lever, panel.Handwheel, panel.Mushroom,
)  # fmt: skip
CELL_MODELS = (
    CellSection, DeviceSection, EmulatorSection, SafetySection, WorkspaceSection, CalibrationRecord, MountRecord,
    IntrinsicsRecord, LoadRecord,
)  # fmt: skip


@pytest.mark.parametrize(
    ("page", "model"),
    [("panel-file.md", model) for model in PANEL_MODELS] + [("cell-file.md", model) for model in CELL_MODELS],
)
def test_every_key_is_documented(page: str, model: type[BaseModel]) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    missing = [field.alias or name for name, field in model.model_fields.items() if (field.alias or name) not in text]
    assert not missing, f"{page} does not mention {missing} of {model.__name__}"
