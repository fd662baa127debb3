"""Kinds of drills: each is drawn from its number, and says which outcomes and words are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.config import load_cell
from hal.panel import Lever

ROOT = Path(__file__).resolve().parents[1]
BENCH = load_cell(ROOT / "cells/bench.toml").panel
OFTEN = ("main_valve", "setpoint", "pump", "mode")


@dataclass(frozen=True, slots=True, kw_only=True)
class Drill:
    """One drill: changes of the cell file, and what may come out.

    Attributes:
        device_fault: (device, options of its fault).
        outcomes: allowed outcomes of the deed, or `error` for a task that fails.
        words: one of these must be in what is said, unless the deed is done.
        deed_first: a deed on another control that runs before, without a fault.
    """

    kind: str
    control: str
    events: tuple[dict[str, Any], ...] = ()
    cables: tuple[dict[str, Any], ...] = ()
    device_fault: tuple[str, dict[str, Any]] | None = None
    outcomes: tuple[str, ...] = ("done",)
    words: tuple[str, ...] = ()
    deed_first: str | None = None
    friction: float | None = None


def drill_of(number: int) -> Drill:
    """Return the drill with a number: the kinds in turn, with everything else drawn from the number."""
    rng = np.random.default_rng([number, 20])
    makers = (
        _dead_force, _dead_touch, _dead_gripper, _frozen, _moved_before, _moved_during, _door, _blocked, _lamp_out,
        _cable, _missing, _slipped,
    )  # fmt: skip
    return makers[(number - 1) % len(makers)](rng)


# The hand holds a lever this far from its hub, which is the place that a fault waits for.
LEVER_M = {one.name: one.length_m for one in BENCH.objects if isinstance(one, Lever)}


def _pick(rng: np.random.Generator, names: Sequence[str]) -> str:
    return str(rng.choice(list(names)))


def _dead(kind: str, device: str, fault: str, rng: np.random.Generator, **more: Any) -> Drill:
    control = _pick(rng, OFTEN)
    near_m = float(rng.uniform(0.03, 0.10)) + LEVER_M.get(control, 0.0)
    when = {"kind": fault, "near": control, "near_m": round(near_m, 3), "at_s": 2.0}
    return Drill(kind=kind, control=control, device_fault=(device, when), outcomes=("error",), words=(device,), **more)


def _dead_force(rng: np.random.Generator) -> Drill:
    return _dead("dead force sensor", "wrist_ft", _pick(rng, ("silent", "disconnected", "stale")), rng)


def _dead_touch(rng: np.random.Generator) -> Drill:
    return _dead("dead touch sensor", "finger_touch", _pick(rng, ("silent", "disconnected", "stale")), rng)


def _dead_gripper(rng: np.random.Generator) -> Drill:
    return _dead("dead gripper", "gripper", _pick(rng, ("silent", "disconnected", "stale")), rng)


def _frozen(rng: np.random.Generator) -> Drill:
    """Freeze a force sensor or a camera, which cannot go unnoticed; a frozen switch that agrees is no fault."""
    return _dead("frozen sensor", _pick(rng, ("wrist_ft", "wrist_camera")), "frozen", rng)


def _shift(rng: np.random.Generator) -> tuple[float, float, float]:
    size = float(np.exp(rng.uniform(np.log(0.0005), np.log(0.030))))
    way = rng.normal(size=3) * np.array([1.0, 1.0, 0.5])
    x, y, z = (size * way / np.linalg.norm(way)).round(5).tolist()
    return x, y, z


MOVED_OUTCOMES = ("done", "missed", "slipped", "stalled", "stiff", "force_limit", "unverified", "unreachable", "error")


def _moved_before(rng: np.random.Generator) -> Drill:
    """Move the panel some seconds after the hand has come to a control: about when the next deed begins."""
    delay_s = round(float(rng.uniform(5.0, 9.0)), 2)
    first, control = (str(name) for name in rng.choice(["setpoint", "pump", "mode"], 2, replace=False))
    event = {"kind": "panel-moves", "shift_m": _shift(rng), "near": first, "near_m": 0.05, "delay_s": delay_s}
    return Drill(
        kind="panel moved between deeds", control=control, events=(event,), deed_first=first, outcomes=MOVED_OUTCOMES,
        words=("moved", "not found", "not show"),
    )  # fmt: skip


def _moved_during(rng: np.random.Generator) -> Drill:
    control = _pick(rng, OFTEN)
    near_m = round(float(rng.uniform(0.03, 0.10)), 3)
    event = {"kind": "panel-moves", "shift_m": _shift(rng), "near": control, "near_m": near_m, "at_s": 2.0}
    return Drill(
        kind="panel moved in a deed", control=control, events=(event,), outcomes=MOVED_OUTCOMES,
        words=("moved", "not found", "not show"),
    )  # fmt: skip


def _door(rng: np.random.Generator) -> Drill:
    control = _pick(rng, OFTEN)
    event = {
        "kind": "panel-moves", "turn_rad": (0.0, float(rng.uniform(0.02, 0.15)) * float(rng.choice([-1.0, 1.0])), 0.0),
        "about_m": (float(rng.choice([-0.3, 0.3])), 0.0, 0.0), "duration_s": 2.0, "near": control, "near_m": 0.12,
        "at_s": 2.0,
    }  # fmt: skip
    return Drill(
        kind="door swings", control=control, events=(event,), outcomes=MOVED_OUTCOMES,
        words=("moved", "not found", "not show"),
    )  # fmt: skip


def _blocked(rng: np.random.Generator) -> Drill:
    control = _pick(rng, ("main_valve", "setpoint", "pump", "mode", "bypass"))
    event = {"kind": "blocked", "object": control}
    outcomes = ("stiff", "stalled", "slipped", "force_limit", "missed")
    return Drill(kind="blocked control", control=control, events=(event,), outcomes=outcomes, words=("N", "not"))


def _lamp_out(rng: np.random.Generator) -> Drill:
    """Break the lamp that shows a button's effect, or a border light."""
    if rng.uniform() < 0.5:
        event = {"kind": "lamp-out", "object": "run_lamp"}
        return Drill(
            kind="lamp out", control="start", events=(event,), outcomes=("slipped", "unverified", "done"),
            words=("read-back", "reading"),
        )  # fmt: skip
    lights = [light.name for light in BENCH.lights]
    event = {"kind": "lamp-out", "object": _pick(rng, lights)}
    return Drill(kind="lamp out", control=_pick(rng, OFTEN), events=(event,), outcomes=("error",), words=("light",))


def _cable(rng: np.random.Generator) -> Drill:
    """Hang a cable across a control, 30 to 60 mm before the plate."""
    control = _pick(rng, OFTEN)
    x, y, z = BENCH.object(control).point_m
    height = z + float(rng.uniform(0.02, 0.05))
    side = float(rng.uniform(-0.01, 0.01))
    cable = {"path_m": [(x - 0.15, y + side, height), (x + 0.15, y + side, height)], "radius_m": 0.004}
    outcomes = ("done", "missed", "unreachable", "force_limit", "slipped", "stalled", "stiff", "unverified", "error")
    return Drill(kind="cable across", control=control, cables=(cable,), outcomes=outcomes, words=("",))


def _missing(rng: np.random.Generator) -> Drill:
    control = _pick(rng, ("main_valve", "setpoint", "pump", "mode", "emergency"))
    event = {"kind": "missing", "object": control}
    return Drill(
        kind="object missing", control=control, events=(event,), outcomes=("error", "missed"),
        words=("not where", "not known", "no cap", "no bat", "there is no", "not show"),
    )  # fmt: skip


def _slipped(rng: np.random.Generator) -> Drill:
    """Grease the pads, so that a wheel slips in the grasp."""
    outcomes = ("done", "slipped", "stalled", "stiff", "unverified", "missed")
    return Drill(
        kind="slipped grasp", control="bypass", friction=float(rng.uniform(0.05, 0.15)), outcomes=outcomes,
        words=("not", "slip"),
    )  # fmt: skip
