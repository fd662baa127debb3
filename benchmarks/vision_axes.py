"""Measures the robustness of taught reading, one axis at a time: the shipped panel is drawn with one disturbance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.vision_disturbance import Disturbance
from benchmarks.vision_drawing import Shown, camera, draw_panel, looking_at
from benchmarks.vision_reliability import Answer
from hal.config import load_cell
from hal.errors import CellError
from hal.geometry import certain
from hal.panel import (
    Button,
    Display,
    Gauge,
    Handwheel,
    Lamp,
    Lever,
    Mushroom,
    Panel,
    PanelMeter,
    Rotary,
    Slider,
    Toggle,
)
from perception.vision.inspection import inspect
from perception.vision.projection import CameraProjection

ROOT = Path(__file__).resolve().parent.parent
SEEDS = range(3)


def shipped_panel() -> Panel:
    """Return the panel of the bench cell."""
    return load_cell(ROOT / "cells" / "bench.toml").panel


def axes() -> list[Answer]:
    """Print for each axis what is read correctly, refused, and wrong by more than 5 % FS; return the answers."""
    panel = shipped_panel()
    answers: list[Answer] = []
    print("\nrobustness, one axis at a time (shipped panel, drawn): read right / refused / wrong above 5 % FS")
    for tilt in (0, 15, 30, 45):
        answers += _axis(f"tilt {tilt} deg", panel, tilt_deg=float(tilt))
    for azimuth in (45, 90, 180, 270):
        answers += _axis(f"tilt 30 deg about {azimuth} deg", panel, tilt_deg=30.0, azimuth_deg=float(azimuth))
    for ratio in (2.0, 4.0, 10.0):
        answers += _axis(f"illumination {ratio:g}:1", panel, disturbance=Disturbance(slope_ratio=ratio))
    for exposure in (0.25, 0.5, 1.5, 2.0):
        answers += _axis(f"exposure x{exposure:g}", panel, disturbance=Disturbance(exposure=exposure))
    for sigma in (1.5, 3.0):
        answers += _axis(f"blur {sigma:g} px", panel, disturbance=Disturbance(blur_sigma_px=sigma))
    for noise in (12.0, 25.0):
        answers += _axis(f"noise {noise:g}", panel, disturbance=Disturbance(noise_sigma=noise))
    for distance in (0.4, 0.7, 1.0):
        answers += _axis(f"distance {distance:g} m", panel, distance_m=distance)
    spot = Disturbance(glare=((300.0, 260.0, 60.0), (800.0, 520.0, 60.0)))
    answers += _axis("two glares", panel, disturbance=spot)
    answers += _axis("a cable", panel, disturbance=Disturbance(cables=((520.0, 0.0, 640.0, 959.0, 14.0),)))
    return answers


def _axis(
    what: str,
    panel: Panel,
    *,
    tilt_deg: float = 0.0,
    azimuth_deg: float = 0.0,
    distance_m: float = 0.62,
    disturbance: Disturbance | None = None,
) -> list[Answer]:
    intrinsics = camera(1280, 960, focal_px=1200.0)
    tilt, azimuth = np.deg2rad(tilt_deg), np.deg2rad(azimuth_deg)
    placed = looking_at(distance_m=distance_m, tilt_rad=tilt, azimuth_rad=azimuth)
    pose = certain(RigidTransform.from_matrix(placed))
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    right = refused = bad = total = 0
    answers: list[Answer] = []
    for seed in SEEDS:
        shown = random_state(panel, seed)
        image = draw_panel(panel, view, (960, 1280), shown, disturbance)
        try:
            readings = inspect(image, intrinsics, pose, panel)
        except CellError:
            refused += len(panel.objects)
            total += len(panel.objects)
            continue
        for reading in readings:
            error = _error(panel, reading, shown[reading.name])
            total += 1
            if error is not None:
                answers.append(Answer(confidence=reading.confidence, right=error <= 2.0))
            refused += error is None
            right += error is not None and error <= 2.0
            bad += error is not None and error > 5.0
    print(f"  {what:24s} {right / total:.2f} / {refused / total:.2f} / {bad / total:.2f}")
    return answers


def random_state(panel: Panel, seed: int) -> dict[str, Shown]:
    """Return a random value or state for every object, the same for the same seed."""
    random = np.random.default_rng(seed)
    shown: dict[str, Shown] = {}
    for panel_object in panel.objects:
        share = float(random.uniform(0.05, 0.95))
        match panel_object:
            case Gauge() | PanelMeter() | Slider():
                shown[panel_object.name] = panel_object.scale.minimum + share * (
                    panel_object.scale.maximum - panel_object.scale.minimum
                )
            case Display():
                shown[panel_object.name] = (
                    f"{panel_object.minimum + share * (panel_object.maximum - panel_object.minimum):.{panel_object.decimals}f}"
                )
            case Lamp() | Toggle():
                shown[panel_object.name] = "on" if share > 0.5 else "off"
            case Button() | Mushroom():
                shown[panel_object.name] = "pressed" if share > 0.5 else "released"
            case Rotary() | Lever():
                shown[panel_object.name] = panel_object.states[int(share * len(panel_object.states))].name
            case Handwheel():
                shown[panel_object.name] = 4.0 * share - 2.0
    return shown


def _error(panel: Panel, reading: Any, shown: Shown) -> float | None:
    """Return the error in % of full scale, 100 for a wrong state or text, None for a refusal."""
    if not reading.answered:
        return None
    if reading.text is not None or reading.state is not None:
        return 0.0 if shown in (reading.text, reading.state) else 100.0
    if reading.kind == "handwheel":
        return float(abs((reading.value - float(shown) + np.pi) % (2 * np.pi) - np.pi) / (2 * np.pi) * 100)
    span = panel.object(reading.name).full_scale
    assert span is not None  # all other kinds have a span
    return float(abs(reading.value - float(shown)) / span * 100)
