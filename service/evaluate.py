"""Compares a finished report with the true state of the simulator, which nothing else in the service reads."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtri

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import InvalidRequest, Unsupported
from hal.geometry import difference
from hal.panel import Panel, PanelObject, Shown
from hal.panel.button import PRESSED_ONCE
from hal.simulated import ObjectTruth, Truth
from service.jsonable import jsonable
from service.processes.connection import CellConnection
from service.report.write import render, write_json
from service.schema.mission_results import ActionClaim, EvaluateResult, ReadingClaim, UnaskedMotion

AFTER = "after the actions"


def evaluate(connection: CellConnection, folder: Path) -> EvaluateResult:
    """Add the section `judge` to the report in `folder` and render it again; returns that section.

    Raises:
        InvalidRequest: there is no such report, or it belongs to the simulator of another cell.
        Unsupported: the cell is not simulated, so the truth is not known.
    """
    if not (folder / "report.json").is_file():
        raise InvalidRequest(f"there is no report of a mission {folder.name!r}", hint="GET /v1/missions lists them")
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    here = {"cell": connection.cell.name, "panel": connection.cell.panel.name, "seed": connection.cell.file.cell.seed}
    for key, value in here.items():
        if report[key] != value:
            raise InvalidRequest(
                f"mission {folder.name!r} was of {key} {report[key]!r}, this service runs {key} {value!r}",
                hint="judge a mission in the service that ran it, because only its simulator has the truth",
            )
    began_s = report.get("started_cell_s", -np.inf)  # reports of older versions do not have this key
    verdict = compare(report, truth_of(connection, connection.clock.now_s() - began_s), connection.cell.panel)
    write_json(folder, {**report, "judge": jsonable(verdict)})
    render(folder)
    return verdict


def truth_of(connection: CellConnection, ago_s: float) -> Truth:
    """Return the true state of a simulated cell, with `initial` from `ago_s` before; only for finished missions."""
    arms = connection.devices_of(DeviceKind.ARM) | connection.behind_wires_of(DeviceKind.ARM)
    for arm in arms.values():
        if hasattr(arm, "truth"):
            truth: Truth = arm.truth(max(0.0, arm.truth().sim_time_s - ago_s))
            return truth
    raise Unsupported(
        "this cell has no simulated arm, so there is no truth to judge by",
        hint="use a cell with sim:arm, on its own or behind an emulator",
    )


def compare(report: dict[str, Any], truth: Truth, panel: Panel) -> EvaluateResult:
    """Compare a report's pose, readings and actions with the truth.

    The truth is known at the end of the mission, so of several actions on one control only the last is judged.
    """
    before = {panel_object.name: panel_object for panel_object in truth.initial}
    after = {panel_object.name: panel_object for panel_object in truth.objects}
    claims = [
        _reading_claim(reading, (after if reading["when"] == AFTER else before)[reading["name"]], panel)
        for k, reading in enumerate(report["readings"])
        if reading["reason"] is None and reading["present"] and not _is_outdated(k, report["readings"])
    ]
    newest = {panel.object(action["object"]).shown_by: action for action in report["actions"]}
    actions = [_action_claim(action, before, after, panel) for action in newest.values()]
    pose = _pose_error(report.get("fused"), truth)
    return EvaluateResult(
        pose_error_m=None if pose is None else float(np.linalg.norm(pose.delta[:3])),
        pose_error_rad=None if pose is None else float(np.linalg.norm(pose.delta[3:])),
        pose_error=None if pose is None else pose.delta.tolist(),
        mahalanobis=None if pose is None else pose.mahalanobis,
        inside_95=None if pose is None else bool(pose.mahalanobis <= chdtri(6, 0.05)),
        claims=[*claims, *actions],
        readings_right=sum(claim.right for claim in claims),
        readings_given=len(claims),
        actions_confirmed=sum(action["confirmed"] for action in report["actions"]),
        agrees=all(action.right for action in actions),
        moved_unasked=_moved_unasked(report["actions"], before, after, panel),
        peak_force_n=truth.peak_force_n,
        sim_time_s=truth.sim_time_s,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseError:
    """Error of the fused pose: `delta` (6,) translation (m), then rotation (rad), and its square in sigmas."""

    delta: Array
    mahalanobis: float


def _pose_error(fused: dict[str, Any] | None, truth: Truth) -> PoseError | None:
    if not fused:
        return None
    estimate = RigidTransform.from_components(fused["translation_m"], Rotation.from_quat(fused["quaternion_xyzw"]))
    delta = difference(RigidTransform.from_matrix(truth.base_from_panel_matrix), estimate)
    distance = float(delta @ np.linalg.solve(np.array(fused["covariance"]), delta))
    return PoseError(delta=delta, mahalanobis=distance)


def _reading_claim(reading: dict[str, Any], truth: ObjectTruth, panel: Panel) -> ReadingClaim:
    spec = panel.object(reading["name"])
    return ReadingClaim(
        name=reading["name"],
        what=f"read {reading['when']}",
        claimed=reading["shows"],
        truth=_shown(truth),
        right=spec.is_right(Shown(**{key: reading[key] for key in ("value", "state", "text")}), shown_of(truth)),
    )


def shown_of(truth: ObjectTruth) -> Shown:
    """Return what an object truly shows, in the terms of the panel file."""
    return Shown(value=truth.value, state=truth.state, text=truth.text)


def _action_claim(
    action: dict[str, Any], before: dict[str, ObjectTruth], after: dict[str, ObjectTruth], panel: Panel
) -> ActionClaim:
    """Judge an action: a confirmed one must have reached its target; an unconfirmed one claims nothing."""
    name = action["object"]
    spec = panel.object(name)
    reached = _reached(spec, action, before, after)
    return ActionClaim(
        name=name,
        what=f"{action['skill']} to {action['target']}",
        claimed=f"{action['outcome']}, {'confirmed' if action['confirmed'] else 'not confirmed'}",
        truth=f"{_shown(before[name])} to {_shown(after[name])}",
        right=reached or not action["confirmed"],
        reached=reached,
    )


def _is_outdated(k: int, readings: list[dict[str, Any]]) -> bool:
    """Return whether the same object was read again after a later action."""
    asked = (readings[k]["name"], AFTER)
    return readings[k]["when"] == AFTER and asked in [(later["name"], later["when"]) for later in readings[k + 1 :]]


def _moved_unasked(
    actions: list[dict[str, Any]], before: dict[str, ObjectTruth], after: dict[str, ObjectTruth], panel: Panel
) -> list[UnaskedMotion]:
    """Return the objects that changed although neither they nor a control that they belong to was operated."""
    worked = {action["object"] for action in actions}
    worked |= {panel.object(name).shown_by for name in worked}
    return [
        UnaskedMotion(name=name, truth=f"{_shown(was)} to {_shown(after[name])}")
        for name, was in before.items()
        if name not in worked and not panel.object(name).is_right(shown_of(was), shown_of(after[name]))
    ]


def _reached(
    spec: PanelObject, action: dict[str, Any], before: dict[str, ObjectTruth], after: dict[str, ObjectTruth]
) -> bool:
    """Return whether the object that shows the result of the action truly shows its target.

    A button that springs back shows nothing afterwards; its simulated switch counts the presses.
    """
    if action["target"] == PRESSED_ONCE:
        return (after[spec.name].value or 0.0) > (before[spec.name].value or 0.0)
    return spec.goal is not None and spec.goal.is_reached(action["target"], shown_of(after[spec.shown_by]))


def _shown(truth: ObjectTruth) -> str:
    if truth.text is not None:
        return truth.text
    if truth.state is not None:
        return truth.state
    return "?" if truth.value is None else f"{truth.value:.4g}"
