"""Touching the plate: which place next, hovering over it and touching it, and what each place told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import (
    CandidateSensing,
    ErrorBudget,
    Observation,
    PoseTolerance,
    ProximityObservation,
    SensingChoice,
    TouchObservation,
    error_budget,
    next_measurement,
)
from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import MotionError, NotFound, Stopped
from hal.geometry import UncertainPose
from manipulation import SkillFailure, plausibility, proximity_probe, touch_points, touch_probe
from service.operations.acquisition import settle
from service.operations.session import Session
from service.operations.travel import skill_context
from service.schema.fuse_results import TouchingResult, TouchResult

HOVER_M = 0.05  # of the fingertips above the plate while the proximity sensors look
HOVER_SAMPLES = 5
LEAST_TOUCHES = 3
LEAST_GAIN = 0.01  # of the pose's mean square error: a touch that is expected to bring less is not made
REST_S = 0.02  # two readings of a proximity sensor
SPARE_SPOTS = 2  # more places than touches: to choose from, and to replace those that the arm cannot reach
TOUCH_S = 2.0  # hovering, approaching and leaving, without the way there
TOUCH_SIGMA_M = 0.0003  # what `touch_probe` states


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Felt:
    """What the fingers found: observations, and what each touch was worth."""

    observations: tuple[Observation, ...]
    account: TouchingResult


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TouchPlan:
    """What is known of the pose, and the places that could be touched next.

    Attributes:
        base_from_panel: the pose believed.
        budget: of all observations so far.
        tolerance: how well the pose is wanted.
        spots_m: (N, 2) places left, panel frame.
        offers: what a touch at each of them would tell.
        tip_m: (2,) where the fingertips are, panel frame.
        speed_m_per_s: of the tips on the way.
    """

    base_from_panel: RigidTransform
    budget: ErrorBudget
    tolerance: PoseTolerance
    spots_m: Array
    offers: tuple[ErrorBudget, ...]
    tip_m: Array
    speed_m_per_s: float

    @property
    def error(self) -> float:
        """Mean square error of the pose in units of the tolerance."""
        return self.tolerance.error_of(self.budget.covariance, self.base_from_panel)

    def choice(self) -> SensingChoice | None:
        """Return the place to touch next, or None when no place is left."""
        if not self.offers:
            return None
        ways_m = np.linalg.norm(self.spots_m - self.tip_m, axis=1)
        candidates = [
            CandidateSensing(budget=offer, cost_s=TOUCH_S + float(way_m) / self.speed_m_per_s)
            for offer, way_m in zip(self.offers, ways_m, strict=True)
        ]
        return next_measurement(self.budget, self.base_from_panel, candidates, tolerance=self.tolerance)

    def without(self, index: int) -> Self:
        """Return the plan without a place."""
        left = [k for k in range(len(self.offers)) if k != index]
        return replace(self, spots_m=self.spots_m[left], offers=tuple(self.offers[k] for k in left))

    def after(self, index: int, told: ErrorBudget) -> Self:
        """Return the plan after a place was touched and its readings told so much."""
        return replace(self.without(index), budget=self.budget.plus(told), tip_m=self.spots_m[index])

    def reason_to_stop(self, choice: SensingChoice | None) -> str:
        """Why no further place needs to be touched; empty when one does."""
        if self.error <= 1.0:
            return "the pose is as good as wanted"
        if choice is None:
            return "no place is left"
        if choice.error_after > (1.0 - LEAST_GAIN) * choice.error_before:
            return f"no further touch is expected to lower the pose's mean square error by {100 * LEAST_GAIN:.0f} %"
        return ""


def feel(session: Session, touches: int, known: Sequence[Observation], tolerance: PoseTolerance) -> Felt:
    """Hover over and touch bare places of the plate, each time the one that tells most per second.

    Ends when the pose is good enough, when no further place is worth the time, or after `touches` places.

    Args:
        touches: at most so many.
        known: what has been observed already.
        tolerance: how well the pose is wanted.

    Raises:
        NotFound: fewer than three places could be touched and the pose is not good enough; says why.
        Stopped: somebody stopped the cell.
    """
    return follow(session, touch_plan(session, touches, known, tolerance), touches)


def follow(session: Session, plan: TouchPlan, touches: int) -> Felt:
    """Touch as the plan says; see `feel`."""
    observations: list[Observation] = []
    accounts: list[TouchResult] = []
    skipped: list[str] = []
    monitor = plausibility.ProximityMonitor(session.panel)
    ended = "as many places as asked for"
    while len(accounts) < touches:
        choice = plan.choice()
        if reason := plan.reason_to_stop(choice):
            ended = reason
            break
        assert choice is not None  # noqa: S101 - there is a reason to stop otherwise
        spot = plan.spots_m[choice.index]
        expected = 100.0 * (1.0 - choice.error_after / choice.error_before)
        session.progress(
            len(accounts) / touches,
            "touch the plate",
            f"at ({spot[0]:.3f}, {spot[1]:.3f}) m, expected to lower the pose's mean square error by {expected:.1f} %",
        )
        try:
            found = _feel_at(session, spot, monitor)
        except Stopped:
            raise  # no place is at fault
        except (SkillFailure, MotionError) as failure:
            skipped.append(f"({spot[0]:.3f}, {spot[1]:.3f}) m: {failure}")
            plan = plan.without(choice.index)
            continue
        observations += found
        told = error_budget(found, mounts_of(session, found), plan.base_from_panel)
        plan = plan.after(choice.index, told)
        accounts.append(_worth(spot, choice, plan.error))
    if len(accounts) < LEAST_TOUCHES and skipped and not plan.offers:
        raise NotFound(
            f"only {len(accounts)} of {touches} places of the plate could be touched: {'; '.join(skipped)}",
            hint="is the panel where the lights say? is something in the way?",
        )
    account = TouchingResult(touches=accounts, skipped=skipped, ended=ended)
    return Felt(observations=tuple(observations), account=account)


def _worth(spot: Array, choice: SensingChoice, error_after: float) -> TouchResult:
    expected, brought = (100.0 * (1.0 - error / choice.error_before) for error in (choice.error_after, error_after))
    return TouchResult(
        spot_m=[float(along) for along in spot],
        error_before=choice.error_before,
        error_expected=choice.error_after,
        error_after=error_after,
        words=f"({spot[0]:.3f}, {spot[1]:.3f}) m: expected to lower the pose's mean square error by {expected:.1f} %, "
        f"lowered it by {brought:.1f} %",
    )


def mounts_of(session: Session, observations: Sequence[Observation]) -> dict[str, UncertainPose]:
    """`flange_from_sensor` of every sensor that gave observations."""
    return {sensor: session.mount(sensor) for sensor in sorted({o.sensor for o in observations})}


def touch_plan(session: Session, touches: int, known: Sequence[Observation], tolerance: PoseTolerance) -> TouchPlan:
    """Offer bare places of the plate, with what a touch at each would tell."""
    base_from_panel = session.known_panel().parent_from_child
    spots_m = touch_points(session.panel, touches + SPARE_SPOTS)
    expected = [_expected_at(session, base_from_panel, spot) for spot in spots_m]
    return TouchPlan(
        base_from_panel=base_from_panel,
        budget=error_budget(known, mounts_of(session, known), base_from_panel, lenses=session.one_sigma_lenses()),
        tolerance=tolerance,
        spots_m=spots_m,
        offers=tuple(error_budget(each, mounts_of(session, each), base_from_panel) for each in expected),
        tip_m=_fingers_over_panel(session),
        speed_m_per_s=session.cell.file.safety.speed_limit_m_per_s,
    )


def _expected_at(session: Session, base_from_panel: RigidTransform, spot: Array) -> list[Observation]:
    """What hovering over a place and touching it would give if the panel stood where it is believed."""
    gripper = session.first(DeviceKind.GRIPPER)
    flange_from_grip = session.mount(gripper).parent_from_child
    facing = Rotation.from_rotvec([np.pi, 0.0, 0.0])  # the fingers point into the plate

    def base_from_flange(height_m: float) -> RigidTransform:
        panel_from_grip = RigidTransform.from_components([float(spot[0]), float(spot[1]), height_m], facing)
        return base_from_panel * panel_from_grip * flange_from_grip.inv()

    touched = TouchObservation(
        sensor=gripper, base_from_flange=base_from_flange(0.0), tip_m=np.zeros(3), sigma_m=TOUCH_SIGMA_M, label="touch"
    )
    expected: list[Observation] = [touched]
    for name in _proximity_sensors(session):
        hovering = base_from_panel.inv() * base_from_flange(HOVER_M) * session.mount(name).parent_from_child
        sigma_m = session.connection.device(name).capabilities().sigma_m
        expected.append(
            ProximityObservation(
                sensor=name,
                base_from_flange=base_from_flange(HOVER_M),
                distance_m=float(-hovering.translation[2] / hovering.rotation.as_matrix()[2, 2]),
                sigma_m=sigma_m * HOVER_SAMPLES**-0.5,
                label=name,
            )
        )
    return expected


def _proximity_sensors(session: Session) -> list[str]:
    return [name for name in session.cell.names_of(DeviceKind.PROXIMITY) if session.has_mount(name)]


def _fingers_over_panel(session: Session) -> Array:
    """(2,) panel point that the finger tips are over."""
    context = skill_context(session)
    tip = context.mover.state().base_from_flange * context.flange_from_grip
    return np.asarray(context.panel_pose.inv().apply(tip.translation)[:2])


def _feel_at(session: Session, spot: Array, monitor: plausibility.ProximityMonitor) -> list[Observation]:
    context = skill_context(session)
    place = (float(spot[0]), float(spot[1]), 0.0)
    observations: list[Observation] = []
    proximities = session.cell.names_of(DeviceKind.PROXIMITY)
    names = _proximity_sensors(session)
    of = {name: session.connection.device(name).capabilities() for name in names}
    mounts = [session.mount(name).parent_from_child for name in names]
    hovered = context.mover.state()
    if names:
        sigma_m = max(each.sigma_m for each in of.values())
        points = proximity_probe(
            context, place, flange_from_sensors=mounts, distance_m=HOVER_M, samples=HOVER_SAMPLES, sigma_m=sigma_m
        )
        hovered = context.mover.state()
        flange = hovered.base_from_flange
        for point in points:
            name = _whose(names, mounts, flange, point.base_from_sensor)
            observations.append(
                ProximityObservation(
                    sensor=name,
                    base_from_flange=flange,
                    distance_m=point.distance_m,
                    sigma_m=point.sigma_m,
                    label=f"{name} at ({spot[0]:.3f}, {spot[1]:.3f})",
                )
            )
    touched = touch_probe(context, place)
    settle(session, REST_S)
    for name, mount in zip(names, mounts, strict=True):
        k = proximities.index(name)
        finding = monitor.note(
            name,
            of[name],
            [(state.base_from_flange * mount, state.proximity_m[k]) for state in (hovered, context.mover.state())],
            base_from_panel=context.panel_pose,
            touched_m=touched.point_m,
        )
        if finding is not None:
            raise finding.error()
    base_from_grip = touched.report.base_from_tool
    tip = base_from_grip.inv().apply(touched.point_m)
    normal_sigma = float(np.sqrt(touched.normal @ touched.covariance @ touched.normal))
    observations.append(
        TouchObservation(
            sensor=session.first(DeviceKind.GRIPPER),
            base_from_flange=base_from_grip * context.flange_from_grip.inv(),
            tip_m=tip,
            sigma_m=normal_sigma,
            label=f"touch at ({spot[0]:.3f}, {spot[1]:.3f})",
        )
    )
    return observations


def _whose(names: Sequence[str], mounts: Sequence[Any], flange: Any, base_from_sensor: Any) -> str:
    """Which sensor stood there: the probe leaves out sensors that saw nothing."""
    gaps = [np.linalg.norm((flange * mount).translation - base_from_sensor.translation) for mount in mounts]
    return names[int(np.argmin(gaps))]
