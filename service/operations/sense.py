"""The verb `fuse`: feeling for the panel with every sense, and one pose from all that was sensed.

The plate is hovered over and touched at the place that tells most per second, until the pose is as good as wanted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import (
    FusedObservations,
    Observation,
    PixelObservation,
    PoseTolerance,
    ProximityObservation,
    SensingChoice,
    TouchObservation,
    TouchPlan,
    error_budget,
    fuse,
    fuse_observations,
)
from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import MotionError, NotFound, Stopped
from hal.geometry import UncertainPose
from manipulation import SkillFailure, plausibility, proximity_probe, touch_points, touch_probe
from service.operations.acquisition import settle
from service.operations.inspect import ensure_located
from service.operations.locate import Located, go_to_overview, locate, scan_plate
from service.operations.session import Session
from service.operations.travel import skill_context
from service.schema.fuse_request import FuseRequest
from service.schema.fuse_results import FuseResult, TouchingResult, TouchResult, answer_of

HOVER_M = 0.05  # of the fingertips above the plate while the proximity sensors look
HOVER_SAMPLES = 5
LEAST_TOUCHES = 3
REST_S = 0.02  # two readings of a proximity sensor
SPARE_SPOTS = 2  # more places than touches, to replace those that the arm cannot reach
TOUCH_SIGMA_M = 0.0003  # what `touch_probe` states


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Felt:
    """What the fingers found: observations, and what each touch was worth."""

    observations: tuple[Observation, ...]
    account: TouchingResult


def fuse_and_remember(session: Session, observations: Sequence[Observation]) -> FusedObservations:
    """One pose from all observations; the cell believes it from now on."""
    fused = fuse_observations(
        observations,
        mounts_of(session, observations),
        lenses=session.one_sigma_lenses(),
        prior=session.believed_panel(),
    )
    session.world.believe_panel(fused.base_from_panel)
    return fused


def fused_result(answer: FusedObservations, felt: Felt) -> FuseResult:
    """The fused pose as reports and the API give it."""
    result = answer_of(answer.base_from_panel, answer.fused, answer.measurements)
    return result.model_copy(update={"touching": felt.account})


def run_fuse(session: Session, request: FuseRequest) -> FuseResult:
    """The verb `fuse`: measurements that are given, or collected."""
    if request.collect:
        observations, felt = collect(session, request)
        return fused_result(fuse_and_remember(session, observations), felt)
    measurements = [body.measurement() for body in request.measurements]
    prior = request.prior.pose() if request.prior is not None else None
    fused = fuse(
        measurements,
        prior=prior,
        shape=request.shape.shape() if request.shape is not None else None,
        certify=request.certify,
        prove_set_within_s=request.prove_set_within_s,
    )
    return answer_of(fused.base_from_object, fused, measurements)


def collect(session: Session, request: FuseRequest) -> tuple[tuple[Observation, ...], Felt]:
    """Look, scan, hover and touch: all observations, and what was felt."""
    ensure_located(session.part(0.0, 0.2))
    go_to_overview(session)
    found: Located = locate(session.part(0.2, 0.3))
    session.progress(0.3, "scan the plate")
    known: tuple[Observation, ...] = (*found.observations, scan_plate(session).observation)
    felt = feel(session.part(0.35, 1.0), request.touches, known, request.wanted.tolerance())
    return (*known, *felt.observations), felt


def light_observations(located: Sequence[Located]) -> tuple[PixelObservation, ...]:
    """The rays of several looks together."""
    return tuple(ray for found in located for ray in found.observations)


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
        places=touches,
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
