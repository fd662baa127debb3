"""Measures model matching on panels with ten kinds of component, each behind a board that hides 40 % of it.

python -m benchmarks.range_matching [--seeds N] [--first S]

Every component of a scene has its own board in front of it, which covers 40 % of its pixels from one side or across the
centre. Between the components are balls and boxes without a model. A match is right if it has the component's kind and
is within 10 mm of its position; a component of which other boards hide more than half is not counted.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range import RangeScene, analyse
from perception.range.matching.match import Match, match_models
from perception.range.matching.models import load_models
from perception.range.recordings import sensor_from_meta

MM = 1000.0
HIDDEN_SHARE = 0.4
MOST_HIDDEN_SHARE = 0.5
RIGHT_WITHIN_M = 0.010


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thing:
    """Component of a scene: kind, pose in the sensor's frame, and symmetry.

    `turns` is the number of rotations about z that look the same, 0 if all do; `state` is in metres or radians, if the
    kind has one that can be measured.
    """

    model: str
    sensor_from_object: Array
    turns: int
    state: float | None
    hidden: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchingCase:
    """Depth image (m) with the scorer's `meta` and the true components."""

    depth_m: Array
    meta: dict[str, Any]
    things: tuple[Thing, ...]


@dataclass(slots=True, kw_only=True, eq=False)
class Tally:
    """Counts over scenes: components found and present per kind, wrong matches, and errors of correct matches."""

    found: dict[str, int]
    there: dict[str, int]
    wrong: list[str]
    place_m: list[float]
    angle_rad: list[float]
    state_error: list[float]
    place_in_sigmas: list[float]

    @property
    def recall(self) -> float:
        """Fraction of the components that were found."""
        return sum(self.found.values()) / max(sum(self.there.values()), 1)

    @property
    def precision(self) -> float:
        """Fraction of the matches that are correct."""
        right = sum(self.found.values())
        return right / max(right + len(self.wrong), 1)


def empty_tally() -> Tally:
    """Return an empty tally."""
    return Tally(found={}, there={}, wrong=[], place_m=[], angle_rad=[], state_error=[], place_in_sigmas=[])


def matching_case(gen: ModuleType, seed: int, *, is_occluded: bool = True, size_px: int = 256) -> MatchingCase:
    """Draw a panel scene of the generator with a toggle lever, a ball handle and clutter, with boards if occluded."""
    rng = np.random.default_rng([seed, sorted(gen.SCENES).index("panel")])
    surfaces, extent, distance = gen.scene_panel(rng)
    plate = surfaces[0]
    R = np.stack([plate["clip"]["u"], np.cross(plate["n"], plate["clip"]["u"]), plate["n"]], axis=1)
    camera_from_panel = (R, np.asarray(plate["c"], float))
    added, more = _added(gen, rng)
    surfaces = [*surfaces, *gen.to_camera(added, *camera_from_panel)]
    sensor = gen.sensor_for("pinhole", size_px, extent, distance)
    truth = _truth(surfaces, camera_from_panel) + [
        (name, np.array([*xy, 0.0]), yaw, turns, None, {k}) for name, k, xy, yaw, turns in more
    ]
    _, bare = gen.cast(surfaces, sensor)
    boards = _boards(gen, surfaces, sensor, bare, truth, rng) if is_occluded else []
    clean, labels = gen.cast([*surfaces, *boards], sensor)
    depth, _, _ = gen.degrade(clean, rng)
    things = []
    for model, place, yaw, turns, state, prefixes in truth:
        mine = _mask(surfaces, bare, prefixes)
        count = int(mine.sum())
        if count < 30:
            continue
        hidden = 1.0 - float((mine & (labels == bare)).sum()) / count
        things.append(
            Thing(
                model=model,
                sensor_from_object=_homogeneous(camera_from_panel, place, yaw),
                turns=turns,
                state=state,
                hidden=hidden,
            )
        )
    meta = {"sensor": sensor, "unit": "mm", "surfaces": [], "seed": seed}
    return MatchingCase(depth_m=np.asarray(depth, float) / MM, meta=meta, things=tuple(things))


def _added(gen: ModuleType, rng: np.random.Generator) -> tuple[list[dict[str, Any]], list[Any]]:
    """Draw a toggle lever, a ball handle, and two things that are in no library, in the panel frame, millimetres."""
    up = np.array([0.0, 0.0, 1.0])
    lever_at, ball_at = np.array([175.0, 140.0, 0]), np.array([-205.0, 10.0, 0])
    lever_at[:2] += rng.uniform(-4, 4, 2)
    ball_at[:2] += rng.uniform(-4, 4, 2)
    turn = rng.uniform(-np.pi, np.pi)
    along = gen.Rz(turn) @ np.array([0.0, 0.38, np.sqrt(1 - 0.38**2)])
    out = gen.cyl(lever_at + up * 3, up, 11.0, 3.0, "lever_nut", (1, 0))
    out += gen.cyl(lever_at + up * 4 + along * 16, along, 5.0, 16.0, "lever_bat", (1, 0))
    out += gen.cyl(ball_at + up * 22, up, 6.0, 22.0, "ball_stem", (0, 0))
    out += gen.sphere(ball_at + up * 60, 20.0 + rng.uniform(-1, 1), "ball_knob")
    box_at = np.array([50.0 + rng.uniform(-4, 4), 55.0 + rng.uniform(-10, 10), 12.0])
    out += gen.box(box_at, np.array([30.0, 22.0, 24.0]), gen.Rz(rng.uniform(-1, 1)), "clutter_box")
    out += gen.sphere([-205.0, 75.0 + rng.uniform(-8, 8), 10.0], 21.0, "clutter_ball")
    more = [("toggle_lever", "lever_", lever_at[:2], turn, 1), ("ball_handle", "ball_", ball_at[:2], 0.0, 0)]
    return out, more


def _truth(surfaces: list[dict[str, Any]], camera_from_panel: tuple[Array, Array]) -> list[Any]:
    """Return (model, position, yaw, turns, state, name prefixes) of the generator's components, panel frame, mm."""
    R, t = camera_from_panel
    by_name = {s["name"]: s for s in surfaces}

    def at(name: str, key: str = "c") -> Array:
        return np.asarray((np.asarray(by_name[name][key]) - t) @ R)

    def heading(name: str, key: str) -> float:
        d = np.asarray(by_name[name][key]) @ R
        return float(np.arctan2(d[1], d[0]))

    flat = np.array([1.0, 1.0, 0.0])
    out: list[Any] = []
    for name in by_name:
        if name.startswith("button") and ":" not in name:
            out.append(("push_button", at(name) * flat, 0.0, 0, None, {name}))
        if name.startswith("knob") and ":" not in name:
            out.append(("rotary_knob", at(name, "apex") * flat, 0.0, 0, None, {name}))
        if name.startswith("lamp"):
            out.append(("indicator_lamp", at(name) * flat, 0.0, 0, None, {name}))
    out.append(("emergency_knob", at("estop_cap") * flat, 0.0, 0, None, {"estop"}))
    out.append(("valve_wheel", at("valve_hub") * flat, heading("spoke0", "axis"), 3, None, {"valve", "spoke"}))
    rail, carriage = at("rail:z+"), at("carriage:z+")
    out.append(("slider", rail * flat, 0.0, 2, float(carriage[0] - rail[0]) / MM, {"rail", "carriage"}))
    out.append(("pipe", at("pipe") * flat, heading("pipe", "axis"), 2, None, {"pipe"}))
    middle = 0.5 * (at("meter:z+") + at("meter:z-"))
    out.append(("meter", middle * flat, heading("meter:x+", "n"), 1, None, {"meter"}))
    return out


def _mask(surfaces: list[dict[str, Any]], labels: NDArray[np.int16], prefixes: set[str] | str) -> NDArray[np.bool_]:
    starts = tuple(prefixes)
    wanted = [k for k, s in enumerate(surfaces, 1) if s["name"].startswith(starts)]
    return np.isin(labels, wanted)


def _homogeneous(camera_from_panel: tuple[Array, Array], place_mm: Array, yaw: float) -> Array:
    R, t = camera_from_panel
    c, s = np.cos(yaw), np.sin(yaw)
    out = np.eye(4)
    out[:3, :3] = R @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    out[:3, 3] = (R @ place_mm + t) / MM
    return out


def _boards(
    gen: ModuleType,
    surfaces: list[dict[str, Any]],
    sensor: dict[str, Any],
    bare: NDArray[np.int16],
    truth: list[Any],
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Draw one board per component, which covers 40 % of its pixels, from one side or as a bar across."""
    depth, _ = gen.cast(surfaces, sensor)
    points = gen.points(depth, sensor)
    out = []
    for k, (_, _, _, _, _, prefixes) in enumerate(truth):
        v, u = np.nonzero(_mask(surfaces, bare, prefixes))
        if u.size < 30:
            continue
        near = float(np.nanmin(points[v, u, 2])) - rng.uniform(15.0, 60.0)
        angle = rng.uniform(0, 2 * np.pi)
        e, f = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        along, across = u * e[0] + v * e[1], u * f[0] + v * f[1]
        first = rng.uniform(0.15, 0.45) if rng.random() < 0.35 else 0.0
        low, high = np.quantile(along, [first, first + HIDDEN_SHARE])
        if first == 0.0:
            low -= 4.0
        middle_px = e * 0.5 * (low + high) + f * 0.5 * (across.min() + across.max())
        scale = near / sensor["f"]
        centre = np.array([(middle_px[0] - sensor["cx"]) * scale, (middle_px[1] - sensor["cy"]) * scale, near])
        half = 0.5 * (high - low) * scale, (0.5 * (across.max() - across.min()) + 4.0) * scale
        tilt = gen.rot([*rng.normal(size=2), 0.0], rng.uniform(0, 0.2))
        edges = dict(kind="rect", u=tilt @ np.array([e[0], e[1], 0.0]), a=half[0], b=half[1])
        out.append(dict(type="plane", name=f"board{k}", n=tilt @ np.array([0, 0, 1.0]), c=centre, clip=edges))
    return out


def count(case: MatchingCase, matches: tuple[Match, ...], tally: Tally) -> None:
    """Add the matches of one scene to the tally; each component is assigned the nearest match of its kind."""
    left = list(matches)
    for thing in case.things:
        place = thing.sensor_from_object[:3, 3]
        candidates = [(float(np.linalg.norm(_place(m) - place)), m) for m in left if m.model == thing.model]
        nearest = min(candidates, key=lambda c: c[0], default=None)
        is_found = nearest is not None and nearest[0] < RIGHT_WITHIN_M
        if nearest is not None and is_found:
            left = [m for m in left if m is not nearest[1]]
        if thing.hidden > MOST_HIDDEN_SHARE:
            continue
        tally.there[thing.model] = tally.there.get(thing.model, 0) + 1
        if nearest is not None and is_found:
            tally.found[thing.model] = tally.found.get(thing.model, 0) + 1
            _note_errors(thing, nearest[1], tally)
    tally.wrong += [f"{case.meta['seed']}: {m.model}" for m in left]


def _place(match: Match) -> Array:
    return np.asarray(match.sensor_from_object.parent_from_child.translation)


def _note_errors(thing: Thing, match: Match, tally: Tally) -> None:
    error = _place(match) - thing.sensor_from_object[:3, 3]
    tally.place_m.append(float(np.linalg.norm(error)))
    R = match.sensor_from_object.parent_from_child.rotation.as_matrix()
    tally.angle_rad.append(_angle(thing.sensor_from_object[:3, :3], R, thing.turns))
    C = match.sensor_from_object.covariance[:3, :3]
    tally.place_in_sigmas.append(float(np.sqrt(error @ np.linalg.pinv(C) @ error / 3)))
    if thing.state is not None and match.state is not None:
        tally.state_error.append(min(abs(match.state - thing.state), abs(match.state + thing.state)))


def _angle(true: Array, found: Array, turns: int) -> float:
    """Return the angle between two orientations, up to the component's symmetry."""
    if turns == 0:
        return float(np.arccos(np.clip(true[:, 2] @ found[:, 2], -1.0, 1.0)))
    angles = []
    for k in range(turns):
        a = 2 * np.pi * k / turns
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
        angles.append(float(np.arccos(np.clip((np.trace(true @ turn @ found.T) - 1) / 2, -1.0, 1.0))))
    return min(angles)


def matched(case: MatchingCase) -> tuple[RangeScene, tuple[Match, ...]]:
    """Analyse the scene; return it with the matches of the shipped library."""
    scene = analyse(case.depth_m, sensor_from_meta(case.meta["sensor"], 1 / MM))
    return scene, match_models(scene, case.depth_m, load_models())


def run(
    gen: ModuleType, seeds: range, *, is_occluded: bool, look: Callable[[MatchingCase, Any, Any], None] | None = None
) -> Tally:
    """Return the tally over all scenes."""
    tally = empty_tally()
    for seed in seeds:
        case = matching_case(gen, seed, is_occluded=is_occluded)
        scene, matches = matched(case)
        count(case, matches, tally)
        if look is not None:
            look(case, scene, matches)
    return tally


def main() -> None:
    """Run the command line; see the module's docstring."""
    from benchmarks.range import DATA, range_module

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=100)
    arguments = parser.parse_args()
    if not (DATA / "gen.py").exists():
        parser.error("the range development data is not beside this repository")
    gen = range_module("gen")
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    for name, is_occluded in (("nothing hidden", False), ("40 % hidden", True)):
        tally = run(gen, seeds, is_occluded=is_occluded)
        print(
            f"{name}: recall {100 * tally.recall:.1f} % of {sum(tally.there.values())} (>= 90), precision "
            f"{100 * tally.precision:.1f} % (>= 95), {summary(tally)}"
        )
        print(json.dumps({k: f"{tally.found.get(k, 0)}/{n}" for k, n in sorted(tally.there.items())}))
        print("wrong:", ", ".join(tally.wrong) or "none")


def summary(tally: Tally) -> str:
    """Return the median and the 90th percentile of the errors as text."""
    if not tally.place_m:
        return "nothing found"
    place, angle = np.array(tally.place_m) * MM, np.degrees(tally.angle_rad)
    text = f"pose {np.median(place):.2f} mm {np.median(angle):.2f} deg"
    text += f" (p90 {np.quantile(place, 0.9):.2f} mm {np.quantile(angle, 0.9):.2f} deg)"
    if tally.state_error:
        text += f", slider {MM * statistics.median(tally.state_error):.2f} mm"
    return text + f", {statistics.median(tally.place_in_sigmas):.2f} sigmas"


if __name__ == "__main__":
    main()
