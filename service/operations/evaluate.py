"""Compares a finished report with what the simulator says really happened. Nothing else ever asks for the truth."""

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
from hal.simulated import ObjectTruth, Truth
from service.jsonable import jsonable
from service.processes.connection import CellConnection
from service.report.write import render, write_json
from service.schema.mission_results import ActionClaim, EvaluateResult, ReadingClaim, UnaskedMotion

AFTER = "after the actions"


def evaluate(connection: CellConnection, folder: Path) -> EvaluateResult:
    """Add `judge` to the report in `folder` and draw it again; returns that part.

    Raises:
        InvalidRequest: there is no such report, or another cell's simulator knows the truth of it.
        Unsupported: the cell is not simulated, so nobody knows the truth.
    """
    if not (folder / "report.json").is_file():
        raise InvalidRequest(f"there is no report of a mission {folder.name!r}", hint="GET /v1/missions lists them")
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    here = {"cell": connection.cell.name, "panel": connection.cell.panel.name, "seed": connection.cell.file.cell.seed}
    for key, value in here.items():
        if report[key] != value:
            raise InvalidRequest(
                f"mission {folder.name!r} was of {key} {report[key]!r}, this service runs {key} {value!r}",
                hint="judge a mission in the service that ran it: the simulator of another one knows nothing of it",
            )
    began_s = report.get("started_cell_s", -np.inf)  # reports of older versions do not say
    verdict = compare(report, truth_of(connection, connection.clock.now_s() - began_s), connection.cell.panel)
    write_json(folder, {**report, "judge": jsonable(verdict)})
    render(folder)
    return verdict


def truth_of(connection: CellConnection, ago_s: float) -> Truth:
    """The truth of a simulated cell, its `initial` from `ago_s` before; ask only when the mission is over."""
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
    """Pose error, reading errors and what really moved, against a report's claims.

    The simulator tells how the mission ended: of several deeds with one control only the last can be judged.
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
    """How far the fused pose is from the truth: `delta` (6,) translation (m), then rotation (rad), and in sigmas squared."""

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
    """The simulator's answer in the words of the panel file."""
    return Shown(value=truth.value, state=truth.state, text=truth.text)


def _action_claim(
    action: dict[str, Any], before: dict[str, ObjectTruth], after: dict[str, ObjectTruth], panel: Panel
) -> ActionClaim:
    """A confirmed action must be true; an unconfirmed one must not claim anything."""
    name = action["object"]
    spec = panel.object(name)
    reached = _reached(spec, action, after)
    return ActionClaim(
        name=name,
        what=f"{action['skill']} to {action['target']}",
        claimed=f"{action['outcome']}, {'confirmed' if action['confirmed'] else 'not confirmed'}",
        truth=f"{_shown(before[name])} to {_shown(after[name])}",
        right=reached or not action["confirmed"],
        reached=reached,
    )


def _is_outdated(k: int, readings: list[dict[str, Any]]) -> bool:
    """Was the same object read again after a later deed?"""
    asked = (readings[k]["name"], AFTER)
    return readings[k]["when"] == AFTER and asked in [(later["name"], later["when"]) for later in readings[k + 1 :]]


def _moved_unasked(
    actions: list[dict[str, Any]], before: dict[str, ObjectTruth], after: dict[str, ObjectTruth], panel: Panel
) -> list[UnaskedMotion]:
    """What shows something else than before and was not worked, nor is lit by what was."""
    worked = {action["object"] for action in actions}
    worked |= {panel.object(name).shown_by for name in worked}
    return [
        UnaskedMotion(name=name, truth=f"{_shown(was)} to {_shown(after[name])}")
        for name, was in before.items()
        if name not in worked and not panel.object(name).is_right(shown_of(was), shown_of(after[name]))
    ]


def _reached(spec: PanelObject, action: dict[str, Any], after: dict[str, ObjectTruth]) -> bool:
    """Whether what shows the deed truly shows its target."""
    return spec.goal is not None and spec.goal.is_reached(action["target"], shown_of(after[spec.shown_by]))


def _shown(truth: ObjectTruth) -> str:
    if truth.text is not None:
        return truth.text
    if truth.state is not None:
        return truth.state
    return "?" if truth.value is None else f"{truth.value:.4g}"
