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
from hal.panel import Button, Panel, PanelObject
from hal.simulated import ObjectTruth, Truth
from service.jsonable import jsonable
from service.processes.connection import CellConnection
from service.report.write import render, write_json
from service.schema.results import ActionClaim, EvaluateResult, ReadingClaim, UnaskedMotion

GAUGE_SHARE = 0.02  # of full scale: a reading further off is wrong
WHEEL_RAD = 0.105
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
    newest = {_shown_by(action["object"], panel): action for action in report["actions"]}
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
        right=agrees(spec, truth, value=reading["value"], state=reading["state"], text=reading["text"]),
    )


def agrees(
    spec: PanelObject, truth: ObjectTruth, *, value: float | None, state: str | None, text: str | None = None
) -> bool:
    """Is what was said of an object true, within 2 % of full scale (6 degrees for a wheel) and exactly for states?"""
    if spec.kind == "display":
        return text is not None and text.strip() == (truth.text or "").strip()
    if truth.state is not None:
        return state == truth.state
    if value is None or truth.value is None:
        return False
    if spec.kind == "handwheel":
        return bool(abs((value - truth.value + np.pi) % (2 * np.pi) - np.pi) <= WHEEL_RAD)
    scale = getattr(spec, "scale", None)
    span = scale.maximum - scale.minimum if scale is not None else 1.0
    return bool(abs(value - truth.value) <= GAUGE_SHARE * span)


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


def _shown_by(name: str, panel: Panel) -> str:
    """What shows that a control was worked: itself, or the lamp of a button."""
    spec = panel.object(name)
    return spec.lights_lamp if isinstance(spec, Button) and spec.lights_lamp is not None else name


def _moved_unasked(
    actions: list[dict[str, Any]], before: dict[str, ObjectTruth], after: dict[str, ObjectTruth], panel: Panel
) -> list[UnaskedMotion]:
    """What shows something else than before and was not worked, nor is lit by what was."""
    worked = {action["object"] for action in actions}
    worked |= {
        panel_object.lights_lamp
        for panel_object in panel.objects
        if isinstance(panel_object, Button) and panel_object.name in worked
    }
    return [
        UnaskedMotion(name=name, truth=f"{_shown(was)} to {_shown(after[name])}")
        for name, was in before.items()
        if name not in worked
        and not agrees(panel.object(name), after[name], value=was.value, state=was.state, text=was.text)
    ]


def _reached(spec: PanelObject, action: dict[str, Any], after: dict[str, ObjectTruth]) -> bool:
    target, now = action["target"], after[spec.name]
    if spec.kind == "button" and spec.lights_lamp is not None:
        return bool(after[spec.lights_lamp].state == target)  # a button springs back: what it works is what counts
    if spec.kind == "slider":
        span = spec.scale.maximum - spec.scale.minimum
        return now.value is not None and bool(abs(now.value - float(target)) <= GAUGE_SHARE * span)
    if spec.kind == "handwheel":
        return now.value is not None and bool(abs(now.value - float(target)) <= WHEEL_RAD)
    return bool(now.state == target)


def _shown(truth: ObjectTruth) -> str:
    if truth.text is not None:
        return truth.text
    if truth.state is not None:
        return truth.state
    return "?" if truth.value is None else f"{truth.value:.4g}"
