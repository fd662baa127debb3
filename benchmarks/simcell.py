"""Simulated bench cell with a controller and a panel pose that is wrong by a given amount.

The tests and the benchmark of the skills use it. It reads the simulator's truth, which skills must not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.clock import SimClock
from hal.config import Cell, load_cell
from hal.devices import DeviceKind
from hal.geometry import UncertainPose, perturbed
from hal.panel import Shown, load_panel
from hal.registry import Context, Shared, connect
from hal.simulated import ObjectTruth
from manipulation.control.controller import Controller
from manipulation.planning.time_parameterization import SpeedLimits
from manipulation.skills.context import SkillContext
from manipulation.skills.operate import operate
from manipulation.skills.outcome import ObjectState, SkillReport, Verify
from service.processes.motion import controller_of, flange_from

ROOT = Path(__file__).resolve().parents[1]


@dataclass
class SimBench:
    """Running simulated cell; skills receive `context`, and only the judge uses `truth`."""

    file: Cell
    clock: SimClock
    shared: Shared
    arm: Any
    controller: Controller
    context: SkillContext
    latched: list[bool]
    rng: np.random.Generator
    devices: dict[str, Any]

    def truth(self, name: str) -> ObjectTruth:
        """Return the true state of an object."""
        found: ObjectTruth = next(o for o in self.arm.truth().objects if o.name == name)
        return found

    def true_panel(self) -> RigidTransform:
        """Return the true pose of the panel, base_from_panel."""
        return RigidTransform.from_matrix(self.arm.truth().base_from_panel_matrix)

    def peak_force_n(self) -> float:
        """Return the largest contact force of the physics engine on the arm."""
        return float(self.arm.truth().peak_force_n)

    def look(self, name: str, *, angle_sigma_rad: float = 0.0, value_sigma: float = 0.0) -> ObjectState:
        """Return a simulated reading after a motion: the truth with the noise of a camera's reading."""
        truth = self.truth(name)
        if truth.value is None:
            return ObjectState(name=name, state=truth.state)
        return ObjectState(
            name=name,
            state=truth.state,
            value=truth.value + value_sigma * float(self.rng.standard_normal()),
            angle_rad=truth.value + angle_sigma_rad * float(self.rng.standard_normal()),
            sigma=value_sigma,
        )

    def operate(
        self, name: str, goal: str | float, *, current: ObjectState | None = None, verify: Verify | None = None
    ) -> SkillReport:
        """Operate a control of the panel by the skill of its kind."""
        return operate(self.context, self.context.panel.object(name), goal, current=current, verify=verify)

    def close(self) -> None:
        """End the controller and the world."""
        self.controller.close()
        self.shared.close()


def _silent(_fraction: float, _text: str) -> None:
    return None


def open_bench(
    seed: int,
    *,
    error_m: float = 0.003,
    error_rad: float = np.radians(1.0),
    speed: float = 0.25,
    progress: Callable[[float, str], None] = _silent,
    panel: Path | None = None,
) -> SimBench:
    """Open the bench of a seed with a panel pose that is wrong by `error_m` and `error_rad` in a random direction.

    Args:
        panel: a panel file other than the cell's own.
    """
    file = load_cell(ROOT / "cells" / "bench.toml", seed=seed)
    if panel is not None:
        file = file.model_copy(update={"panel": load_panel(panel)})
    clock, shared = SimClock(), Shared()
    made: dict[str, Any] = {}
    for name, section in file.file.devices.items():
        if section.kind in (DeviceKind.CAMERA, DeviceKind.RANGE_SCANNER, DeviceKind.LIGHTS):
            continue
        context = Context(name=name, clock=clock, cell=file, shared=shared)
        made[name] = connect(context, section.driver, dict(section.options))
    latched = [False]
    controller = controller_of(file, made, clock=clock, is_latched=lambda: latched[0])
    rng = np.random.default_rng([seed, 1])
    true = RigidTransform.from_matrix(made["arm"].truth().base_from_panel_matrix)
    skill_context = SkillContext(
        mover=controller,
        kinematics=controller.kinematics,
        panel=file.panel,
        base_from_panel=_believed(true, error_m, error_rad, rng),
        flange_from_grip=flange_from(file, made["gripper"]),
        limits=SpeedLimits(tip_m_per_s=speed, joint_ratio=0.8, acceleration_ratio=0.6),
        park_rad=np.asarray(file.file.workspace.park_rad),
        floor_z_m=file.file.workspace.floor_z_m,
        seed=seed,
        progress=progress,
    )
    bench = SimBench(file, clock, shared, made["arm"], controller, skill_context, latched, rng, made)
    levers = [panel_object.name for panel_object in file.panel.objects if panel_object.kind == "lever"]
    shown = {name: Shown(value=float(bench.truth(name).value or 0.0)) for name in levers}
    bench.context = replace(skill_context, shown=shown)
    return bench


def _believed(true: RigidTransform, error_m: float, error_rad: float, rng: np.random.Generator) -> UncertainPose:
    """Return the pose with an error of that size in a random direction."""
    directions = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    error = np.concatenate([error_m * directions[0], error_rad * directions[1]])
    covariance = np.diag([error_m**2 / 3] * 3 + [error_rad**2 / 3] * 3) + 1e-12 * np.eye(6)
    return UncertainPose(parent_from_child=perturbed(true, error), covariance=covariance)
